"""Squared distances between two sets of points in units of length scales, fast and with all derivatives.

|x − z|² = |x|² + |z|² − 2 xᵀz by one matrix product: `torch.cdist` has no second derivative. Points are first
moved near the origin, since the three terms cancel where points lie close together but far from zero: the
error is a few machine epsilons of the squared distance to the centre, not of the squared inputs.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs

# Multiplications, over the whole batch, up to which differences written out beat the matrix product and its
# preparation: measured at 30 to 50 thousand on one CPU core. They also round less.
DIRECT_SIZE = 32_768


def log_gaussian(
    x: Inputs, z: OtherInputs, log_lengthscale: Tensor, log_outputscale: Tensor | None = None
) -> CrossMatrix:
    """Compute log σ² − ½ Σ_d (x_d − z_d)²/ℓ_d² for every pair of rows: [*batch, N, M].

    The same tensor given twice has exactly log σ² on its diagonal. Elsewhere rounding may leave a squared
    distance a few machine epsilons below zero. Clamping is left to callers whose next step needs it: it would
    cut the second derivative at coincident points, where the squared exponential has a large one.

    Args:
        x: points [*batch, N, D].
        z: points [*batch, M, D].
        log_lengthscale: log ℓ [*batch, D].
        log_outputscale: log σ² [*batch]; 0 unless told.
    """
    same = x is z
    x, z = x.to(log_lengthscale.dtype), z.to(log_lengthscale.dtype)
    tensors = (x, z, log_lengthscale) if log_outputscale is None else (x, z, log_lengthscale, log_outputscale)
    needs_grad = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    offset = None if log_outputscale is None else log_outputscale[..., None, None]
    if not needs_grad and max(x.numel() * z.shape[-2], z.numel() * x.shape[-2]) <= DIRECT_SIZE:
        return _by_differences(x, z, log_lengthscale, offset)
    exponent = _by_matrix_product(x, z, log_lengthscale, offset)
    if same:
        diagonal = exponent.diagonal(dim1=-2, dim2=-1)
        diagonal.copy_(torch.zeros_like(diagonal) if offset is None else offset.squeeze(-1))
    return exponent


class GaussianBumps:
    """x ↦ σ² exp(−½ Σ_d (z_d − x_d)²/ℓ_d²) [*batch, M, N] for one z [*batch, M, D], prepared beforehand.

    The values of one x lie side by side in memory, as triangular solvers want them.

    Args:
        z: points [*batch, M, D], at least one.
        log_lengthscale: log ℓ [*batch, D].
        log_outputscale: log σ² [*batch].
    """

    def __init__(self, z: OtherInputs, log_lengthscale: Tensor, log_outputscale: Tensor) -> None:
        with torch.no_grad():
            self.weight = log_lengthscale.mul(-2).exp_().unsqueeze(-1)  # ℓ⁻²
            self.centre = z[..., :1, :].to(self.weight.dtype)
            points = z - self.centre
            square = (points.square() @ self.weight).mT
            self.columns = points.mT * self.weight  # z/ℓ²
            self.peak = torch.sub(log_outputscale[..., None, None], square, alpha=0.5)  # log σ² − ½|z|²/ℓ²
        self._arrays: tuple[np.ndarray, ...] | None = None

    def __call__(self, x: Inputs) -> Float[Tensor, "... M N"]:
        """Covariances with x [*batch, N, D]."""
        x = x.to(self.peak.dtype) - self.centre
        exponent = torch.sub(self.peak, x.square() @ self.weight, alpha=0.5)
        if x.ndim == self.columns.ndim == 2:  # in place: a copy costs as much as the product
            exponent.addmm_(x, self.columns)
        elif x.ndim == 3 and x.shape[:-2] == self.columns.shape[:-2]:
            exponent.baddbmm_(x, self.columns)
        else:
            exponent = exponent + x @ self.columns
        return exponent.exp_().mT

    def of_one(self, x: np.ndarray) -> np.ndarray:
        """Covariances [M] with one point x [D], for a batch of one on the CPU: NumPy's calls cost less."""
        if self._arrays is None:
            points = self.columns.mT.reshape(-1, len(x))
            others = (self.peak, self.centre, self.weight)
            self._arrays = points.numpy(), *(other.numpy().reshape(-1) for other in others)
        points, peak, centre, weight = self._arrays
        x = x - centre
        exponent = points.dot(x)
        exponent += peak
        exponent -= 0.5 * weight.dot(x * x)
        return np.exp(exponent, out=exponent)


def _by_differences(x: Tensor, z: Tensor, log_lengthscale: Tensor, offset: Tensor | None) -> Tensor:
    inverse = log_lengthscale.neg().exp_().unsqueeze(-2)
    square = torch.cdist(x * inverse, z * inverse, compute_mode="donot_use_mm_for_euclid_dist").square_()
    return square.mul_(-0.5) if offset is None else torch.sub(offset, square, alpha=0.5)


def _by_matrix_product(x: Tensor, z: Tensor, log_lengthscale: Tensor, offset: Tensor | None) -> Tensor:
    weight = log_lengthscale.mul(-2.0).exp_().unsqueeze(-2)  # ℓ⁻²
    x, z = _centred(x, z)
    x_norm = x.square() @ weight.mT
    z_norm = weight @ z.square().mT
    row = z_norm.mul(-0.5) if offset is None else torch.sub(offset, z_norm, alpha=0.5)
    return (x @ (z * weight).mT).sub_(x_norm, alpha=0.5).add_(row)


def weighted_square_distance(x: Inputs, z: OtherInputs, weight: Inputs) -> CrossMatrix:
    """Compute Σ_d w_nd (x_nd − z_md)² [*batch, N, M] with weights [*batch, N, D] of each row of x."""
    x, z = _centred(x.to(weight.dtype), z.to(weight.dtype))
    weighted = weight * x
    cross = torch.cat((weight.expand_as(weighted), weighted), -1) @ torch.cat((z.square(), -2 * z), -1).mT
    return cross + (weighted * x).sum(-1, keepdim=True)


def _centred(x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Both sets moved so that the first point of z is the origin; no distance changes."""
    if x.shape[-2] == 0 or z.shape[-2] == 0:
        return x, z
    centre = z[..., :1, :].detach()
    return x - centre, z - centre
