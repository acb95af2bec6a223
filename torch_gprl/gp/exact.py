"""Dense Gaussian process regression: the yardstick that the sparse online process is measured against.

Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, algorithm 2.1. O(N³) in the number of
points and nothing clever: every answer is computed afresh from the data and today's parameters, and hence
differentiable in them.

| paper | here | meaning |
|---|---|---|
| X, y | `self.inputs`, `self.targets` | the data |
| L | `L` | Cholesky factor of K(X, X) + σ²I |
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import MultivariateNormal

from torch_gprl.gp.posterior import Posterior
from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter
from torch_gprl.linalg import cholesky
from torch_gprl.typing import Inputs, Targets


class ExactGP(nn.Module):
    """Gaussian process regression with zero prior mean, batched over leading dimensions.

    Args:
        kernel: prior covariance.
        noise_variance: variance of the noise on targets, in their squared units; broadcasts to the kernel's
            batch_shape.

    Raises:
        ValueError: a noise variance that is not positive and finite.
    """

    noise_variance = Positive()
    inputs: Tensor
    targets: Tensor

    def __init__(self, kernel: Kernel, noise_variance: PositiveValue = 1e-2) -> None:
        super().__init__()
        self.kernel = kernel
        self.log_noise_variance = log_parameter(noise_variance, "noise_variance", kernel.batch_shape)
        like = self.log_noise_variance.detach()
        self.register_buffer("inputs", like.new_zeros(0, kernel.input_dim), persistent=False)
        self.register_buffer("targets", like.new_zeros(0), persistent=False)

    def fit(self, inputs: Inputs, targets: Targets) -> "ExactGP":
        """Take data [*batch, N, D] and [*batch, N] in place of any before; parameters stay as they are."""
        self.inputs, self.targets = inputs.to(self.log_noise_variance), targets.to(self.log_noise_variance)
        return self

    def posterior(self, inputs: Inputs) -> Posterior:
        """Mean and variance of f at inputs [*batch, M, D]."""
        L, whitened_targets = self._whiten()
        A = torch.linalg.solve_triangular(L, self.kernel(self.inputs, inputs), upper=False)
        # mean = k*ᵀ(K + σ²I)⁻¹y,  variance = k** − k*ᵀ(K + σ²I)⁻¹k*
        mean = (A.mT @ whitened_targets).squeeze(-1)
        return Posterior(mean, self.kernel.diag(inputs) - A.square().sum(-2))

    def joint(self, inputs: Inputs) -> MultivariateNormal:
        """Joint distribution of f at inputs [*batch, M, D], to draw whole functions from."""
        L, whitened_targets = self._whiten()
        A = torch.linalg.solve_triangular(L, self.kernel(self.inputs, inputs), upper=False)
        covariance = self.kernel(inputs, inputs) - A.mT @ A
        return MultivariateNormal((A.mT @ whitened_targets).squeeze(-1), scale_tril=cholesky(covariance))

    def log_marginal_likelihood(self) -> Float[Tensor, "*batch"]:
        """Log density of the targets given inputs and parameters: [*batch], differentiable in the latter."""
        L, whitened_targets = self._whiten()
        # −½ yᵀ(K + σ²I)⁻¹y − ½ log|K + σ²I| − N/2 log 2π
        fit = whitened_targets.square().sum((-2, -1))
        half_log_determinant = L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return -0.5 * fit - half_log_determinant - 0.5 * self.targets.shape[-1] * math.log(2 * math.pi)

    def _whiten(self) -> tuple[Tensor, Tensor]:
        """L = chol(K + σ²I) and L⁻¹y as a column."""
        K = self.kernel(self.inputs, self.inputs)
        noise = self.noise_variance[..., None, None] * torch.eye(K.shape[-1], dtype=K.dtype, device=K.device)
        L = cholesky(K + noise)
        return L, torch.linalg.solve_triangular(L, self.targets.unsqueeze(-1), upper=False)
