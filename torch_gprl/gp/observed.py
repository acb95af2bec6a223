"""What a process is told in one block: values of f with noise, or differences of two values."""

from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.kernels.gaussian_inputs import GaussianInputs


class Observed(NamedTuple):
    """A block of linear observations y = f(x) − γ f(x') + noise; the second term for transitions only."""

    inputs: Float[Tensor, "*batch N D"]
    targets: Float[Tensor, "*batch N"]
    mask: Bool[Tensor, "*batch N"] | None
    next_inputs: GaussianInputs | None
    discount: Float[Tensor, "*batch N"] | None

    def block(self, start: int, stop: int) -> "Observed":
        """The points from `start` to `stop`."""
        chosen = slice(start, stop)
        following = self.next_inputs
        return Observed(
            self.inputs[..., chosen, :],
            self.targets[..., chosen],
            None if self.mask is None else self.mask[..., chosen],
            following
            and GaussianInputs(
                following.mean[..., chosen, :], following.variance[..., chosen, :], following.columns
            ),
            None if self.discount is None else self.discount[..., chosen],
        )
