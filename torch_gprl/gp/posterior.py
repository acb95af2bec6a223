"""What a Gaussian process says about points: mean and variance of the latent function."""

from typing import NamedTuple

from torch import Tensor

from torch_gprl.typing import PerPoint


class Posterior(NamedTuple):
    """Mean and variance of f at points, without observation noise; unpacks as `mean, variance = ...`."""

    mean: PerPoint
    """Expected value [*batch, N], in units of the targets."""
    variance: PerPoint
    """Variance [*batch, N], in squared units of the targets."""

    @property
    def stddev(self) -> PerPoint:
        """Standard deviation [*batch, N]."""
        return self.variance.sqrt()

    def predictive(self, noise_variance: Tensor | float) -> "Posterior":
        """The distribution of a noisy target: the noise variance, broadcast against [*batch, N], is added."""
        return Posterior(self.mean, self.variance + noise_variance)
