"""The one guarded Cholesky factorisation of the project, and its only jitter.

A Gram matrix of near duplicates is positive definite on paper and fails in floating point by a few units of
roundoff. The guard lives here and nowhere else: it adds the smallest diagonal that helps, only to the batch
entries that failed, never more than half of the digits, and otherwise says what is wrong.
"""

import torch
from torch import Tensor

from torch_gprl.typing import SquareMatrix

FIRST_JITTER_IN_EPS = 100.0  # machine epsilons: about the roundoff of a Gram matrix of 100 points
JITTER_GROWTH = 10.0


class CholeskyError(ValueError):
    """A matrix has no Cholesky factor, even with the largest jitter allowed; the message says why."""


def cholesky(matrix: SquareMatrix, max_jitter: float | None = None) -> SquareMatrix:
    """Lower Cholesky factor L with L Lᵀ = matrix, and jitter on the batch entries that need it.

    Reads the lower triangle only. Entries that fail are tried again with jitter · mean(diagonal) added to
    their diagonal, the jitter growing tenfold from 100 machine epsilons. Differentiable; the jitter counts as
    a constant. Costs one host synchronisation, to ask whether any entry failed. In a
    compiled graph there is no second try.

    Args:
        matrix: symmetric positive semi-definite matrices [*batch, N, N].
        max_jitter: largest jitter relative to the mean diagonal; half of the digits (the square root of the
            machine epsilon, 1.5e-8 in float64) unless told. 0 forbids jitter.

    Raises:
        CholeskyError: an entry holds NaN or infinity, or is not positive definite with the largest jitter.
    """
    if torch.compiler.is_compiling():  # a graph cannot branch on `info`; this one raises by itself
        return torch.linalg.cholesky(matrix)
    factor, info = torch.linalg.cholesky_ex(matrix)
    if _succeeded(factor, info):
        return factor
    _refuse_non_finite(matrix)
    eps = torch.finfo(matrix.dtype).eps
    limit = eps**0.5 if max_jitter is None else max_jitter
    scale = matrix.detach().diagonal(dim1=-2, dim2=-1).mean(-1)
    added = torch.zeros_like(scale)
    jitter = FIRST_JITTER_IN_EPS * eps
    while jitter <= limit:
        added = torch.where(info > 0, jitter * scale, added)
        diagonal = added.unsqueeze(-1).expand(matrix.shape[:-1])
        factor, info = torch.linalg.cholesky_ex(matrix + torch.diag_embed(diagonal))
        if _succeeded(factor, info):
            return factor
        jitter *= JITTER_GROWTH
    raise CholeskyError(_not_positive_definite(matrix, info, limit))


def _succeeded(factor: Tensor, info: Tensor) -> bool:
    # `info` may let NaN and infinity pass; they end in the pivots, and neither is less than infinity
    pivots = factor.diagonal(dim1=-2, dim2=-1)
    return bool((pivots.sum() < torch.inf) & ~info.any())


def _refuse_non_finite(matrix: Tensor) -> None:
    bad = ~matrix.isfinite()
    if bad.any():
        raise CholeskyError(
            f"cholesky needs finite numbers, got {int(bad.sum())} NaN or infinite ones in a matrix of shape "
            f"{tuple(matrix.shape)}, {matrix.dtype}; look for NaN in the inputs, or for a length scale, "
            "output scale or noise variance that ran off to 0 or infinity"
        )


def _not_positive_definite(matrix: Tensor, info: Tensor, limit: float) -> str:
    first = matrix.reshape(-1, *matrix.shape[-2:])[int(info.reshape(-1).nonzero()[0])].detach()
    return (
        f"cholesky needs positive definite matrices, got {int((info > 0).sum())} that are not; the first "
        f"has size {matrix.shape[-1]}, {matrix.dtype}, mean diagonal {float(first.diagonal().mean()):.3g}, "
        f"smallest eigenvalue {float(torch.linalg.eigvalsh(first)[0]):.3g}; jitter tried up to "
        f"{limit:.1g} of the mean diagonal; use float64, raise the noise variance or the novelty threshold, "
        "drop near-duplicate points, or check that the kernel is positive semi-definite"
    )
