"""Inputs of which some columns are Gaussian: states with the actions that a policy may take in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.typing import Inputs


@dataclass(frozen=True)
class GaussianInputs:
    """Points [*batch, N, D] whose `columns` are independent Gaussians and whose other columns are known.

    Args:
        mean: the points; in the Gaussian columns, their means.
        variance: variances [*batch, N, A] of the A Gaussian columns, in squared units of the inputs; 0 is
            allowed.
        columns: which columns are Gaussian, in the order of `variance`.

    Raises:
        ValueError: columns that repeat or do not exist, or that `variance` does not match.
    """

    mean: Inputs
    variance: Float[Tensor, "*#batch N A"]
    columns: tuple[int, ...]

    def __post_init__(self) -> None:
        dims = self.mean.shape[-1]
        if len(set(self.columns)) != len(self.columns) or not set(self.columns) <= set(range(dims)):
            raise ValueError(f"columns must be distinct numbers from 0 to {dims - 1}, got {self.columns}")
        if self.variance.shape[-1] != len(self.columns):
            raise ValueError(
                f"variance needs one column for each of {self.columns}, got shape "
                f"{tuple(self.variance.shape)}"
            )

    @classmethod
    def exactly(cls, points: Inputs) -> "GaussianInputs":
        """Points [*batch, N, D] without a Gaussian column."""
        return cls(points, points[..., :0], ())

    def select(self, columns: Sequence[int]) -> "GaussianInputs":
        """The given columns alone, numbered anew."""
        kept = [i for i, column in enumerate(columns) if column in self.columns]
        source = [self.columns.index(columns[i]) for i in kept]
        return GaussianInputs(_columns(self.mean, columns), _columns(self.variance, source), tuple(kept))

    def points_first(self) -> "GaussianInputs":
        """Every point on its own, its index as the first batch dimension: means [N, *batch, 1, D]."""
        mean, variance = (t.movedim(-2, 0).unsqueeze(-2) for t in (self.mean, self.variance))
        return GaussianInputs(mean, variance, self.columns)

    def full_variance(self) -> Inputs:
        """Variance of every column [*batch, N, D]: zero where the column is known."""
        batch = torch.broadcast_shapes(self.mean.shape[:-1], self.variance.shape[:-1])
        zero = self.variance.new_zeros(*batch, self.mean.shape[-1])
        variance = self.variance.expand(*batch, len(self.columns))
        known = [zero[..., column] for column in range(self.mean.shape[-1])]
        for i, column in enumerate(self.columns):
            known[column] = variance[..., i]
        return torch.stack(known, -1)


def _columns(tensor: Tensor, columns: Sequence[int]) -> Tensor:
    """Columns of a tensor, without an index tensor, which would have to travel to the device first."""
    return torch.stack([tensor[..., column] for column in columns], -1) if columns else tensor[..., :0]
