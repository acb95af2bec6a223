"""Stationary kernels with one length scale per input column (automatic relevance determination).

Rasmussen and Williams (2006), section 4.2.1. With r² = Σ_d (x_d − z_d)² / ℓ_d² and the output scale σ²:

    squared exponential   σ² exp(−r²/2)
    Matérn 1/2            σ² exp(−r)
    Matérn 3/2            σ² (1 + √3 r) exp(−√3 r)
    Matérn 5/2            σ² (1 + √5 r + 5r²/3) exp(−√5 r)
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_gprl.kernels.base import Kernel, Positive, log_parameter
from torch_gprl.kernels.distance import scaled_square_distance
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Stationary(Kernel):
    """A kernel of the difference of its inputs, each column in units of its own length scale."""

    lengthscale = Positive()
    outputscale = Positive()

    def __init__(
        self,
        input_dim: int,
        lengthscale: Tensor | float = 1.0,
        outputscale: Tensor | float = 1.0,
        batch_shape: Sequence[int] = (),
    ) -> None:
        """Set the parameters.

        Args:
            input_dim: number of input columns D.
            lengthscale: distance over which the function varies, in units of the inputs; broadcasts to
                [*batch_shape, D].
            outputscale: prior variance, in squared units of the targets; broadcasts to [*batch_shape].
            batch_shape: independent hyper-parameters, one set per learner.
        """
        super().__init__(input_dim, batch_shape)
        self.log_lengthscale = log_parameter(lengthscale, "lengthscale", (*batch_shape, input_dim))
        self.log_outputscale = log_parameter(outputscale, "outputscale", batch_shape)

    def diag(self, x: Inputs) -> PerPoint:
        """The output scale at every row of x [*batch, N, D]: [*batch, N]."""
        batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
        return self.outputscale.unsqueeze(-1).expand(*batch, x.shape[-2])

    def _scaled(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Both sets in units of the length scales, one tensor for both if they are one."""
        inverse = self.log_lengthscale.neg().exp().unsqueeze(-2)
        scaled = x * inverse
        return scaled, scaled if z is x else z * inverse


class SquaredExponential(Stationary):
    """σ² exp(−r²/2): infinitely smooth functions."""

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        # the output scale goes into the exponent, where it is free
        exponent = scaled_square_distance(*self._scaled(x, z), scale=-0.5, offset=self.log_outputscale)
        return exponent.exp_()


class Matern(Stationary):
    """σ² times a Matérn correlation of smoothness 1/2, 3/2 or 5/2: functions with 0, 1 or 2 derivatives."""

    def __init__(
        self,
        input_dim: int,
        lengthscale: Tensor | float = 1.0,
        outputscale: Tensor | float = 1.0,
        smoothness: float = 1.5,
        batch_shape: Sequence[int] = (),
    ) -> None:
        """Set the parameters.

        Args:
            input_dim: number of input columns D.
            lengthscale: distance over which the function varies, in units of the inputs; broadcasts to
                [*batch_shape, D].
            outputscale: prior variance, in squared units of the targets; broadcasts to [*batch_shape].
            smoothness: 0.5, 1.5 or 2.5.
            batch_shape: independent hyper-parameters, one set per learner.

        Raises:
            ValueError: another smoothness.
        """
        if smoothness not in (0.5, 1.5, 2.5):
            raise ValueError(
                f"smoothness of a Matern kernel must be 0.5, 1.5 or 2.5, got {smoothness}; "
                f"for infinity take SquaredExponential"
            )
        super().__init__(input_dim, lengthscale, outputscale, batch_shape)
        self.smoothness = smoothness

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        square = scaled_square_distance(*self._scaled(x, z), scale=2 * self.smoothness)
        # t = √(2ν) r. The root's slope is infinite at 0: the floor keeps coincident points at slope 0, which
        # is right for ν ≥ 3/2 and the subgradient to take at the kink for ν = 1/2.
        t = square.clamp(min=torch.finfo(square.dtype).tiny).sqrt()
        decay = self.outputscale[..., None, None] * t.neg().exp()
        if self.smoothness == 0.5:
            return decay
        if self.smoothness == 1.5:
            return (1 + t) * decay
        return (1 + t + t.square() / 3) * decay
