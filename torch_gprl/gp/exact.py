"""Dense Gaussian process regression: the yardstick that the sparse online GP is measured against.

Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, algorithm 2.1. O(N³) in the number of
points and nothing clever: every quantity is computed afresh from the data and today's parameters, hence
differentiable in them.

| paper | here | meaning |
|---|---|---|
| L | `L` | Cholesky factor of K(X, X) + σ²I |
| K(X, X*) | `Kxs` | prior covariance of data and test points |
"""

import math
from typing import Self

import torch
from torch import Tensor, nn
from torch.distributions import MultivariateNormal

from torch_gprl.gp.posterior import Posterior
from torch_gprl.kernels.base import Kernel, Positive, log_parameter
from torch_gprl.linalg import cholesky
from torch_gprl.typing import Inputs, Targets


class ExactGP(nn.Module):
    """Gaussian process regression with zero prior mean, batched over leading dimensions."""

    noise_variance = Positive()

    def __init__(self, kernel: Kernel, noise_variance: Tensor | float = 1e-2) -> None:
        """Take a prior; there are no data until `fit`.

        Args:
            kernel: prior covariance.
            noise_variance: variance of the noise on targets; broadcasts to the kernel's batch_shape.
        """
        super().__init__()
        self.kernel = kernel
        self.log_noise_variance = log_parameter(noise_variance, "noise_variance", kernel.batch_shape)
        self.inputs: Tensor | None = None
        self.targets: Tensor | None = None

    def fit(self, inputs: Inputs, targets: Targets) -> Self:
        """Keep the data [*batch, N, D] and [*batch, N]; replaces earlier data."""
        self.inputs, self.targets = inputs, targets
        return self

    def posterior(self, inputs: Inputs) -> Posterior:
        """Mean and variance of f at inputs [*batch, M, D]; the prior before `fit`."""
        prior = self.kernel.diag(inputs)
        if self.inputs is None:
            return Posterior(torch.zeros_like(prior), prior)
        L, whitened_targets = self._whiten()
        A = torch.linalg.solve_triangular(L, self.kernel(self.inputs, inputs), upper=False)  # L⁻¹ Kxs
        # mean = Ksx (Kxx + σ²I)⁻¹ y,  variance = kss − diag Ksx (Kxx + σ²I)⁻¹ Kxs
        return Posterior((A.mT @ whitened_targets).squeeze(-1), prior - A.square().sum(-2))

    def joint(self, inputs: Inputs) -> MultivariateNormal:
        """Joint distribution of f at inputs [*batch, M, D], to draw whole functions from."""
        Kss = self.kernel(inputs, inputs)
        if self.inputs is None:
            return MultivariateNormal(torch.zeros_like(Kss[..., 0]), scale_tril=cholesky(Kss))
        L, whitened_targets = self._whiten()
        A = torch.linalg.solve_triangular(L, self.kernel(self.inputs, inputs), upper=False)
        return MultivariateNormal((A.mT @ whitened_targets).squeeze(-1), scale_tril=cholesky(Kss - A.mT @ A))

    def log_marginal_likelihood(self) -> Tensor:
        """Evidence log p(targets | inputs, parameters) [*batch], differentiable in kernel and noise.

        Raises:
            RuntimeError: before `fit`.
        """
        if self.targets is None:
            raise RuntimeError(
                "the likelihood is of data, and there are none; call fit(inputs, targets) first"
            )
        L, whitened_targets = self._whiten()
        # −½ yᵀ(K + σ²I)⁻¹y − ½ log|K + σ²I| − N/2 log 2π
        half_log_det = L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        count = self.targets.shape[-1]
        return (
            -0.5 * whitened_targets.square().sum((-2, -1))
            - half_log_det
            - 0.5 * count * math.log(2 * math.pi)
        )

    def _whiten(self) -> tuple[Tensor, Tensor]:
        """L = chol(Kxx + σ²I) and L⁻¹ y as a column."""
        assert self.inputs is not None
        assert self.targets is not None
        K = self.kernel(self.inputs, self.inputs)
        noise = self.noise_variance[..., None].expand(K.shape[:-1])
        L = cholesky(K + torch.diag_embed(noise))
        return L, torch.linalg.solve_triangular(L, self.targets.unsqueeze(-1), upper=False)
