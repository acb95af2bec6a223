"""Repair of kernels of path lengths: a correlation near a given matrix that is positive semi-definite.

exp(−P²/2ℓ²) of path lengths P is no covariance on most graphs: on a ring of four nodes its smallest
eigenvalue is −0.08. Setting negative eigenvalues to zero gives the nearest positive semi-definite matrix in
the Frobenius norm (Higham, 1988); scaling its diagonal back to one keeps it positive semi-definite. A floor
a little above zero keeps it invertible: what a Gaussian process has learned must survive changes of it.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx

Square = Float[Tensor, "*batch C C"]
FLOOR = 1e-6  # smallest eigenvalue, where the diagonal is one


def repaired_correlation(matrix: Square) -> Square:
    """The matrix with eigenvalues raised to the floor, then scaled to a diagonal of ones.

    Args:
        matrix: symmetric, with positive diagonal [*batch, C, C]. Differentiable in it.
    """
    clipped = _ClipEigenvalues.apply(matrix)
    assert isinstance(clipped, Tensor)
    scale = clipped.diagonal(dim1=-2, dim2=-1).rsqrt()
    return clipped * scale.unsqueeze(-1) * scale.unsqueeze(-2)


class _ClipEigenvalues(torch.autograd.Function):
    """V max(λ, floor) Vᵀ. Autograd of `eigh` divides by differences of eigenvalues; graphs repeat them."""

    @staticmethod
    def forward(ctx: FunctionCtx, matrix: Tensor) -> Tensor:
        eigenvalues, V = torch.linalg.eigh(matrix)
        ctx.save_for_backward(eigenvalues, V)
        return (V * eigenvalues.clamp_min(FLOOR).unsqueeze(-2)) @ V.mT

    @staticmethod
    def backward(ctx: FunctionCtx, *gradients: Tensor) -> Tensor:
        eigenvalues, V = ctx.saved_tensors  # pyright: ignore[reportAttributeAccessIssue]
        # Daleckii and Krein: divided differences of max(λ, floor), its derivative where eigenvalues coincide
        kept = eigenvalues.clamp_min(FLOOR)
        rise = kept.unsqueeze(-1) - kept.unsqueeze(-2)
        run = eigenvalues.unsqueeze(-1) - eigenvalues.unsqueeze(-2)
        close = run.abs() < 1e-12 * eigenvalues.abs().amax(-1)[..., None, None]
        slope = torch.where(close, (eigenvalues > FLOOR).to(run.dtype).unsqueeze(-1), rise / run)
        inner = V.mT @ ((gradients[0] + gradients[0].mT) / 2) @ V
        return V @ (slope * inner) @ V.mT
