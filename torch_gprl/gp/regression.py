"""Several functions of the same inputs, solved at once on a chosen basis.

The sparse posterior of `SparseOnlineGP` for data that are all at hand: T targets share inputs, kernel and
noise, so they share the factorisations too. In whitened coordinates (Csató and Opper, 2002; Snelson and
Ghahramani, 2006, for the weights)

    φ = L⁻¹k(X_B, x),   A = I + Σ φφᵀ/(σ² + ν),   mean = φᵀA⁻¹ Σ φ y/(σ² + ν),   ν = k(x, x) − φᵀφ
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.kernels import Kernel
from torch_gprl.linalg import cholesky


class SparseRegression:
    """Posterior of T functions at once; means are differentiable in the inputs, all else has no gradients.

    Args:
        kernel: prior covariance of each of the functions.
        basis: [*batch, B, D] basis vectors.
        inputs: [*batch, N, D].
        targets: [*batch, N, T].
        noise_variance: [*batch], of the targets.
    """

    @torch.no_grad()
    def __init__(
        self, kernel: Kernel, basis: Tensor, inputs: Tensor, targets: Tensor, noise_variance: Tensor
    ) -> None:
        self._kernel, self._against = kernel, kernel.against(basis)
        self._gram_factor = cholesky(kernel(basis, basis))
        phi = self._features(inputs)
        novelty = (kernel.diag(inputs) - phi.square().sum(-2)).clamp_min(0)
        weighted = phi / (noise_variance.unsqueeze(-1) + novelty).unsqueeze(-2)
        eye = torch.eye(phi.shape[-2], dtype=phi.dtype, device=phi.device)
        self._precision_factor = cholesky(eye + weighted @ phi.mT)
        weights = torch.cholesky_solve(weighted @ targets, self._precision_factor)
        self.coefficients = torch.linalg.solve_triangular(self._gram_factor.mT, weights, upper=True)
        self._mean = kernel.expansion(basis, self.coefficients)

    def _features(self, inputs: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self._gram_factor, self._against(inputs), upper=False)

    def mean(self, inputs: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N T"]:
        """Posterior means at inputs [*batch, N, D]."""
        return self._mean(inputs)

    @torch.no_grad()
    def variance(self, inputs: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N"]:
        """Posterior variance of each of the functions, without noise; it is the same for all."""
        phi = self._features(inputs)
        half = torch.linalg.solve_triangular(self._precision_factor, phi, upper=False)
        explained = phi.square().sum(-2) - half.square().sum(-2)
        return (self._kernel.diag(inputs) - explained).clamp_min(0)
