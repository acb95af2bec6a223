"""Kernels on chosen columns of wider inputs: one for states times one for actions, one for angles."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Columns(Kernel):
    """A kernel that sees some columns of its inputs: `Columns(k, (0, 2), 5)` sees columns 0 and 2 of five.

    Args:
        kernel: the kernel, of input_dim `len(columns)`.
        columns: distinct numbers from 0 to input_dim − 1, in the order in which the kernel takes them.
        input_dim: number of columns of the whole inputs.

    Raises:
        ValueError: columns that repeat, do not exist, or are not as many as the kernel takes.
    """

    columns_index: Tensor

    def __init__(self, kernel: Kernel, columns: Sequence[int], input_dim: int) -> None:
        super().__init__(input_dim, kernel.batch_shape)
        if len(columns) != kernel.input_dim or len(set(columns)) != len(columns):
            raise ValueError(f"columns must be {kernel.input_dim} distinct numbers, got {tuple(columns)}")
        if not set(columns) <= set(range(input_dim)):
            raise ValueError(f"columns must lie between 0 and {input_dim - 1}, got {tuple(columns)}")
        self.kernel = kernel
        self.columns = tuple(columns)
        self.register_buffer("columns_index", torch.tensor(self.columns, dtype=torch.long), persistent=False)

    @property
    def active_columns(self) -> frozenset[int]:
        """The input columns on which the kernel depends."""
        return frozenset(self.columns[i] for i in self.kernel.active_columns)

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        seen = self._select(x)
        return self.kernel(seen, seen if z is x else self._select(z))

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return self.kernel.diag(self._select(x))

    def _select(self, x: Tensor) -> Tensor:
        first, count = self.columns[0], len(self.columns)
        if self.columns == tuple(range(first, first + count)):
            return x[..., first : first + count]  # a view
        return x.index_select(-1, self.columns_index)

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        return self.kernel.expected(x.select(self.columns), z.select(self.columns))
