"""The linear kernel: straight lines with Gaussian slopes and intercept.

Rasmussen and Williams (2006), section 4.2.2: b + wᵀx with b ~ N(0, σ_b²), w_d ~ N(0, σ_d²) has covariance
σ_b² + Σ_d σ_d² x_d z_d.
"""

from collections.abc import Callable, Sequence

from torch import Tensor

from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Linear(Kernel):
    """σ_b² + Σ_d σ_d² x_d z_d: Bayesian linear regression.

    Args:
        input_dim: number of input columns D.
        slope_variance: σ_d², prior variance of the slope along each column; broadcasts to [*batch_shape, D].
        bias_variance: σ_b², prior variance of the value at the origin, in squared units of the targets;
            broadcasts to [*batch_shape].
        batch_shape: independent hyper-parameters, one set per learner.
    """

    slope_variance = Positive()
    bias_variance = Positive()

    def __init__(
        self,
        input_dim: int,
        slope_variance: PositiveValue = 1.0,
        bias_variance: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
    ) -> None:
        super().__init__(input_dim, batch_shape)
        self.log_slope_variance = log_parameter(slope_variance, "slope_variance", (*batch_shape, input_dim))
        self.log_bias_variance = log_parameter(bias_variance, "bias_variance", batch_shape)

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        slope_variance = self.slope_variance.unsqueeze(-2)
        return x.to(slope_variance.dtype) @ (z * slope_variance).mT + self.bias_variance[..., None, None]

    def against(self, z: OtherInputs) -> Callable[[Inputs], CrossMatrix]:
        """The function x ↦ k(z, x): one matrix product; see `Kernel.against`."""
        weighted = (z * self.slope_variance.unsqueeze(-2)).detach()
        bias = self.bias_variance[..., None, None].detach()
        return lambda x: weighted @ x.to(weighted.dtype).mT + bias

    def expansion(self, z: OtherInputs, weights: Tensor) -> Callable[[Inputs], Tensor]:
        """The functions x ↦ Σ_m k(x, z_m) w_m: straight lines; see `Kernel.expansion`."""
        slopes = ((z * self.slope_variance.unsqueeze(-2)).mT @ weights).detach()
        offset = (self.bias_variance[..., None, None] * weights.sum(-2, keepdim=True)).detach()
        return lambda x: x.to(slopes.dtype) @ slopes + offset

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return (x.square() * self.slope_variance.unsqueeze(-2)).sum(-1) + self.bias_variance[..., None]

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        return self(x.mean, z.mean)  # bilinear in independent arguments
