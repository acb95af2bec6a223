"""The sparse online Gaussian process, point by point: the slow, plain twin of the fast one.

Csató and Opper (2002), Sparse on-line Gaussian processes, Neural Computation 14(3). It keeps the textbook
quantities α, C and K⁻¹ and grows and shrinks its tensors. Its explicit inverse loses its digits on long
streams of near duplicates: use it to check, not to work.

| paper | here | meaning |
|---|---|---|
| α, C | `alpha`, `C` | mean = kᵀα, variance = k** + kᵀCk; C is negative semi-definite |
| Q | `gram_inverse` | K⁻¹ over the basis (Q is the action value elsewhere) |
| ê | `e` | K⁻¹k: the projection of the new point on the basis |
| γ | `novelty` | k** − kᵀK⁻¹k |
"""

from typing import Literal

import torch
from torch import Tensor

from torch_gprl.gp.posterior import Posterior
from torch_gprl.kernels.base import Kernel
from torch_gprl.typing import Inputs, Targets

NOVELTY_FLOOR = 1e-10  # of the prior variance: below it K⁻¹ would be noise


class RecursiveGP:
    """Online Gaussian process regression on at most `budget` basis vectors, one target at a time.

    A point joins the basis if its novelty exceeds `novelty_threshold · noise_variance`; if the basis is then
    over budget, the vector of smallest score leaves. Unbatched, without gradients.

    Args:
        kernel: prior covariance.
        budget: most basis vectors allowed.
        noise_variance: variance of the noise on targets.
        novelty_threshold: novelty above which a point joins the basis, in noise variances.
        projection: "moment" keeps the exact marginal posterior of the basis values where a point is projected
            or a vector deleted; "dtc" predicts the value that goes from the basis, as if without residual.
        score: loss by a vector's deletion; "mean" is (α_i/K⁻¹_ii)², the squared change of the mean there,
            "kl" is α_i²/(K⁻¹_ii + C_ii).
    """

    def __init__(
        self,
        kernel: Kernel,
        budget: int,
        noise_variance: float,
        novelty_threshold: float = 0.3,
        projection: Literal["moment", "dtc"] = "moment",
        score: Literal["mean", "kl"] = "mean",
    ) -> None:
        self.kernel = kernel
        self.budget = budget
        self.noise_variance = noise_variance
        self.novelty_threshold = novelty_threshold
        self.projection = projection
        self.score = score
        like = next(kernel.parameters())
        self.basis = like.new_zeros(0, kernel.input_dim)
        self.alpha = like.new_zeros(0)
        self.C = like.new_zeros(0, 0)
        self.gram_inverse = like.new_zeros(0, 0)

    @property
    def size(self) -> int:
        """Number of basis vectors in use."""
        return len(self.basis)

    @torch.no_grad()
    def update(self, inputs: Inputs, targets: Targets) -> None:
        """Learn from points [N, D] and targets [N], in order of arrival."""
        for point, target in zip(inputs, targets, strict=True):
            self._learn(point.unsqueeze(0), target)
            if self.size > self.budget:
                self.delete(int(self.scores().argmin()))

    @torch.no_grad()
    def posterior(self, inputs: Inputs) -> Posterior:
        """Mean and variance of f at inputs [N, D]."""
        k = self.kernel(inputs, self.basis)
        return Posterior(k @ self.alpha, self.kernel.diag(inputs) + ((k @ self.C) * k).sum(-1))

    def scores(self) -> Tensor:
        """Loss of deleting each basis vector [size]; the smallest goes first."""
        precision = self.gram_inverse.diagonal()
        if self.score == "kl":
            return self.alpha.square() / (precision + self.C.diagonal())
        return (self.alpha / precision).square()

    def delete(self, i: int) -> None:
        """Drop basis vector i: marginalise its value ("moment") or predict it from the others' ("dtc")."""
        keep = torch.arange(self.size, device=self.basis.device) != i
        Q, C, alpha = self.gram_inverse, self.C, self.alpha
        t = Q[keep, i] / Q[i, i]
        if self.projection == "moment":
            cross = torch.outer(t, C[i, keep])
            self.alpha = alpha[keep] - t * alpha[i]
            self.C = C[keep][:, keep] + C[i, i] * torch.outer(t, t) - cross - cross.mT
        else:
            s = Q[keep, i] + C[keep, i]
            self.alpha = alpha[keep] - s * alpha[i] / (Q[i, i] + C[i, i])
            self.C = C[keep][:, keep] + Q[i, i] * torch.outer(t, t) - torch.outer(s, s) / (Q[i, i] + C[i, i])
        self.gram_inverse = Q[keep][:, keep] - Q[i, i] * torch.outer(t, t)
        self.basis = self.basis[keep]

    def _learn(self, point: Tensor, target: Tensor) -> None:
        k = self.kernel(self.basis, point).squeeze(-1)
        k_point = self.kernel.diag(point).squeeze()
        e = self.gram_inverse @ k
        novelty = k_point - k @ e
        mean = k @ self.alpha
        variance = k_point + k @ self.C @ k
        residual_variance = self.noise_variance + variance
        if novelty > max(self.novelty_threshold * self.noise_variance, NOVELTY_FLOOR * float(k_point)):
            s = torch.cat([self.C @ k, k.new_ones(1)])
            self._grow(point, e, novelty)
        else:
            s = self.C @ k + e
            if self.projection == "dtc":
                residual_variance = residual_variance - novelty
        # α += q s, C += r s sᵀ with q = (y − m)/(σ² + v), r = −1/(σ² + v)
        self.alpha = self.alpha + s * (target - mean) / residual_variance
        self.C = self.C - torch.outer(s, s) / residual_variance

    def _grow(self, point: Tensor, e: Tensor, novelty: Tensor) -> None:
        """Add a basis vector that carries no information yet."""
        column = torch.cat([e, -e.new_ones(1)])
        pad = torch.nn.functional.pad
        self.basis = torch.cat([self.basis, point])
        self.alpha = pad(self.alpha, (0, 1))
        self.C = pad(self.C, (0, 1, 0, 1))
        self.gram_inverse = pad(self.gram_inverse, (0, 1, 0, 1)) + torch.outer(column, column) / novelty
