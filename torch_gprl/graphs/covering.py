"""Points that cover others: Gonzalez (1985), "Clustering to minimize the maximum intercluster distance".

No choice of as many points covers the others more than twice as tightly.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Cover(NamedTuple):
    """Points chosen one by one.

    Attributes:
        chosen: [*batch, M] indices, no point twice.
        distance: [*batch, M] of each to the nearest of those before it, falling; infinite for the first.
    """

    chosen: Int[Tensor, "*batch M"]
    distance: Float[Tensor, "*batch M"]


@torch.no_grad()
def farthest_points(points: Float[Tensor, "*batch N D"], count: int) -> Cover:
    """Choose min(count, N) points: the first of them, then always the one farthest from those before."""
    square = points.square().sum(-1)
    nearest = torch.full_like(square, torch.inf)
    index = torch.zeros(*square.shape[:-1], 1, dtype=torch.long, device=points.device)
    picks, distances = [index], [nearest[..., :1]]
    for _ in range(min(count, points.shape[-2]) - 1):
        point = points.take_along_dim(index.unsqueeze(-1), -2)
        away = square - 2 * (points @ point.mT).squeeze(-1) + square.gather(-1, index)
        nearest = torch.minimum(nearest, away).scatter(-1, index, -torch.inf)  # roundoff picks none twice
        farthest, index = nearest.max(-1, keepdim=True)
        picks.append(index)
        distances.append(farthest)
    return Cover(torch.cat(picks, -1), torch.cat(distances, -1).clamp_min(0).sqrt())
