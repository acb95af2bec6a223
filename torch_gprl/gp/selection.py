"""Which points of a block join the basis: a partially pivoted Cholesky of what the basis misses.

Given the block's residual Gram matrix S = K(X, X) − ΦᵀΦ, the point of largest residual variance ("novelty")
joins first, the others' residuals shrink by what they share with it, and so on. The rows that come out are
exactly the new rows of Φ = L⁻¹K(X_B, X).
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Selection(NamedTuple):
    """Up to J points of a block of N that join the basis; `accepted` entries form a prefix."""

    pivots: Int[Tensor, "*batch J"]
    accepted: Bool[Tensor, "*batch J"]
    rows: Float[Tensor, "*batch J N"]
    novelty: Float[Tensor, "*batch N"]


def select_novel(
    residual_gram: Float[Tensor, "*batch N N"],
    novelty: Float[Tensor, "*batch N"],
    threshold: Float[Tensor, "*batch N"],
    limit: Int[Tensor, "*batch"],
) -> Selection:
    """Pick points by largest novelty over threshold until none exceeds it or `limit` have been picked.

    Args:
        residual_gram: K(X, X) − ΦᵀΦ of the block, [*batch, N, N].
        novelty: its diagonal, [*batch, N]; −inf where a point may not be picked.
        threshold: smallest novelty worth a basis vector, [*batch, N].
        limit: most points to pick, per learner [*batch].

    Returns:
        the picks in order, the new rows of Φ, and the novelty that is left. One host synchronisation a pick.
    """
    pick = _pick_alone if novelty.ndim == 1 else _pick_batched
    return pick(residual_gram, novelty, threshold, limit)


def _pick_alone(residual_gram: Tensor, novelty: Tensor, threshold: Tensor, limit: Tensor) -> Selection:
    """One learner: the picks are host numbers, and steps work on views. Twice as fast as a batch of 1."""
    most = min(int(limit), novelty.shape[0])
    excess = novelty - threshold
    rows = residual_gram.new_empty(most, novelty.shape[0])
    pivots: list[int] = []
    for pick in range(most):
        pivot = int(excess.argmax())
        if not float(excess[pivot]) > 0:
            break
        row, earlier = rows[pick], rows[:pick]
        torch.addmv(residual_gram[pivot], earlier.mT, earlier[:, pivot], alpha=-1, out=row)
        row.mul_(row[pivot].rsqrt())
        excess.addcmul_(row, row, value=-1)
        excess[pivot] = -torch.inf
        pivots.append(pivot)
    index = torch.tensor(pivots, dtype=torch.long, device=novelty.device)
    left = (excess + threshold).index_fill_(0, index, 0.0)  # nothing is missed of a basis vector
    return Selection(index, torch.ones_like(index, dtype=torch.bool), rows[: len(pivots)], left)


def _pick_batched(residual_gram: Tensor, novelty: Tensor, threshold: Tensor, limit: Tensor) -> Selection:
    """All learners in step, those that are done masked out."""
    points = novelty.shape[-1]
    rows = residual_gram.new_zeros((*novelty.shape[:-1], 0, points))
    excess = novelty - threshold
    pivots, accepts = [], []
    for pick in range(points):
        best, pivot = excess.max(-1)
        accept = (best > 0) & (limit > pick)
        if not bool(accept.any()):
            break
        index = pivot[..., None, None]
        column = residual_gram.gather(-2, index.expand(*pivot.shape, 1, points))
        shared = rows.gather(-1, index.expand(*pivot.shape, pick, 1))  # the pivot's entries in earlier rows
        row = column - shared.mT @ rows
        row = torch.where(accept[..., None, None], row * row.gather(-1, index).rsqrt(), 0.0)
        rows = torch.cat([rows, row], -2)
        shrink = row.squeeze(-2).square()
        novelty, excess = novelty - shrink, excess - shrink
        excess = torch.where(accept[..., None], excess.scatter(-1, pivot[..., None], -torch.inf), excess)
        pivots.append(pivot)
        accepts.append(accept)
    if not pivots:
        none = novelty.new_zeros((*novelty.shape[:-1], 0), dtype=torch.long)
        return Selection(none, none.bool(), rows, novelty)
    return Selection(torch.stack(pivots, -1), torch.stack(accepts, -1), rows, novelty)
