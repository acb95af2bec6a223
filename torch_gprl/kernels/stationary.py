"""Stationary kernels with one length scale per input column (automatic relevance determination).

Rasmussen and Williams (2006), section 4.2.1. With r² = Σ_d (x_d − z_d)² / ℓ_d² and the output scale σ²:

    squared exponential   σ² exp(−r²/2)
    Matérn 1/2            σ² exp(−r)
    Matérn 3/2            σ² (1 + √3 r) exp(−√3 r)
    Matérn 5/2            σ² (1 + √5 r + 5r²/3) exp(−√5 r)
    rational quadratic    σ² (1 + r²/2α)^−α
    periodic              σ² exp(−2 Σ_d sin²(π (x_d − z_d)/p_d) / ℓ_d²)
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.distance import GaussianBumps, log_gaussian, weighted_square_distance
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter, positive
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Stationary(Kernel):
    """A kernel of the difference of its inputs, each column in units of its own length scale.

    Args:
        input_dim: number of input columns D.
        lengthscale: ℓ, distance over which functions vary, in units of the inputs; broadcasts to
            [*batch_shape, D].
        outputscale: σ², prior variance, in squared units of the targets; broadcasts to [*batch_shape].
        batch_shape: independent hyper-parameters, one set per learner.

    Raises:
        ValueError: a parameter that is not positive and finite, or of another shape.
    """

    lengthscale = Positive()
    outputscale = Positive()

    def __init__(
        self,
        input_dim: int,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
    ) -> None:
        super().__init__(input_dim, batch_shape)
        self.log_lengthscale = log_parameter(lengthscale, "lengthscale", (*batch_shape, input_dim))
        self.log_outputscale = log_parameter(outputscale, "outputscale", batch_shape)

    def diag(self, x: Inputs) -> PerPoint:
        """The output scale at every row of x [*batch, N, D]: [*batch, N]."""
        if not self.batch_shape:
            return self.outputscale.expand(x.shape[:-1])
        batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
        return self.outputscale.unsqueeze(-1).expand(*batch, x.shape[-2])


class SquaredExponential(Stationary):
    """σ² exp(−r²/2): infinitely smooth functions. Arguments as `Stationary`."""

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        return log_gaussian(x, z, self.log_lengthscale, self.log_outputscale).exp_()

    def against(self, z: OtherInputs) -> Callable[[Inputs], CrossMatrix]:
        """The function x ↦ k(z, x), three times faster than `forward` for small x; see `Kernel.against`."""
        if z.shape[-2] == 0:
            return super().against(z)
        return GaussianBumps(z, self.log_lengthscale, self.log_outputscale)

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        # A Gaussian column of variance v widens ℓ² to ℓ² + v:
        # E k = σ² Π ℓ/√(ℓ² + v) exp(−½ Σ (μ − z)²/(ℓ² + v))
        if not x.columns:
            return self._expected(z, x).mT
        square_lengthscale = self.lengthscale.square().unsqueeze(-2)
        width = square_lengthscale + x.full_variance()  # [*batch, N, D]
        if z.columns:
            width = width.unsqueeze(-2) + z.full_variance().unsqueeze(-3)  # [*batch, N, M, D]
            square = ((x.mean.unsqueeze(-2) - z.mean.unsqueeze(-3)).square() / width).sum(-1)
            shrink = (width / square_lengthscale.unsqueeze(-2)).log().sum(-1)
        else:
            square = weighted_square_distance(x.mean, z.mean, 1 / width)
            shrink = (width / square_lengthscale).log().sum(-1, keepdim=True)
        return (self.log_outputscale[..., None, None] - 0.5 * (square + shrink)).exp()


class Matern(Stationary):
    """σ² times a Matérn correlation of smoothness 1/2, 3/2 or 5/2: functions with 0, 1 or 2 derivatives.

    Args:
        input_dim: number of input columns D.
        lengthscale: ℓ, as `Stationary`.
        outputscale: σ², as `Stationary`.
        batch_shape: independent hyper-parameters, one set per learner.
        smoothness: 0.5, 1.5 or 2.5.

    Raises:
        ValueError: another smoothness, or parameters that are not positive and finite.
    """

    def __init__(
        self,
        input_dim: int,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
        smoothness: float = 1.5,
    ) -> None:
        if smoothness not in (0.5, 1.5, 2.5):
            raise ValueError(
                f"smoothness must be 0.5, 1.5 or 2.5, got {smoothness}; SquaredExponential is the limit"
            )
        super().__init__(input_dim, lengthscale, outputscale, batch_shape)
        self.smoothness = smoothness

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        # t = √(2ν) r. The root's slope is infinite at 0: the floor gives coincident points slope 0, which is
        # right for ν ≥ 3/2, and a subgradient at the kink of ν = 1/2.
        exponent = log_gaussian(x, z, self.log_lengthscale)  # −r²/2
        t = exponent.mul_(-4 * self.smoothness).clamp_(min=torch.finfo(exponent.dtype).tiny).sqrt_()
        decay = (self.log_outputscale[..., None, None] - t).exp_()
        if self.smoothness == 0.5:
            return decay
        if self.smoothness == 1.5:
            return torch.addcmul(decay, t, decay)
        return torch.addcmul(decay, torch.addcmul(t, t, t, value=1 / 3), decay)


class RationalQuadratic(Stationary):
    """σ² (1 + r²/2α)^−α: a mixture of squared exponentials of many length scales; they agree as α → ∞.

    Args:
        input_dim: number of input columns D.
        lengthscale: ℓ, as `Stationary`.
        outputscale: σ², as `Stationary`.
        batch_shape: independent hyper-parameters, one set per learner.
        mixture: α, how alike the length scales are; broadcasts to [*batch_shape].
    """

    mixture = Positive()

    def __init__(
        self,
        input_dim: int,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
        mixture: PositiveValue = 1.0,
    ) -> None:
        super().__init__(input_dim, lengthscale, outputscale, batch_shape)
        self.log_mixture = log_parameter(mixture, "mixture", batch_shape)

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        mixture = self.mixture[..., None, None]
        exponent = log_gaussian(x, z, self.log_lengthscale)  # −r²/2
        return (self.log_outputscale[..., None, None] - mixture * torch.log1p(-exponent / mixture)).exp_()


class Periodic(Stationary):
    """σ² exp(−2 Σ_d sin²(π (x_d − z_d)/p_d) / ℓ_d²): functions that repeat, such as those of angles.

    MacKay (1998), Introduction to Gaussian processes: the squared exponential of (cos, sin) of the phase. The
    period is known, not learned.

    Args:
        input_dim: number of input columns D.
        lengthscale: ℓ, in radians of phase: a small one acts as that of `SquaredExponential`; broadcasts to
            [*batch_shape, D].
        outputscale: σ², as `Stationary`.
        batch_shape: independent hyper-parameters, one set per learner.
        period: p, in units of the inputs; broadcasts to [*batch_shape, D]. A full turn unless told.
    """

    period: Tensor

    def __init__(
        self,
        input_dim: int,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
        period: PositiveValue = 2 * math.pi,
    ) -> None:
        super().__init__(input_dim, lengthscale, outputscale, batch_shape)
        shape = torch.Size((*batch_shape, input_dim))
        self.register_buffer("period", positive(period, "period").expand(shape).clone())

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        # |(cos, sin)(φ) − (cos, sin)(ψ)|² = 4 sin²((φ − ψ)/2)
        circle = self._on_circle(x)
        other = circle if z is x else self._on_circle(z)
        log_lengthscale = torch.cat((self.log_lengthscale, self.log_lengthscale), -1)
        return log_gaussian(circle, other, log_lengthscale, self.log_outputscale).exp_()

    def _on_circle(self, x: Tensor) -> Tensor:
        phase = x * (2 * math.pi / self.period).unsqueeze(-2)
        return torch.cat((phase.cos(), phase.sin()), -1)
