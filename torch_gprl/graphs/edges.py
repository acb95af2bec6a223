"""Which nodes of a graph are joined, and how long an edge is: by threshold, equation (.18), or by nearness.

The thesis joins a new node to those with exp(−d²) > γ and takes d² as length. Squared lengths are no metric
(a straight line gets shorter the more nodes lie on it), so plain lengths are the default here.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# (new node [*batch, D], nodes [*batch, C, D], which are in use [*batch, C]) -> lengths of the edges between
# the new node and the others [*batch, C], infinite where there is none.
EdgeRule = Callable[[Tensor, Tensor, Tensor], Tensor]


class ThresholdEdges:
    """Equation (.18): an edge where exp(−d²) > `edge_threshold`, that is where d < √(−ln edge_threshold).

    Args:
        edge_threshold: between 0 (every pair) and 1 (none).
        squared: lengths d², as printed, and not d.

    Raises:
        ValueError: a threshold outside (0, 1).
    """

    def __init__(self, edge_threshold: float = 0.7, squared: bool = False) -> None:
        if not 0 < edge_threshold < 1:
            raise ValueError(f"edge_threshold must lie between 0 and 1, got {edge_threshold}")
        self.reach = math.sqrt(-math.log(edge_threshold))
        self.squared = squared

    def __call__(
        self,
        point: Float[Tensor, "*batch D"],
        nodes: Float[Tensor, "*batch C D"],
        used: Bool[Tensor, "*batch C"],
    ) -> Float[Tensor, "*batch C"]:
        """Edges from `point` to those rows of `nodes` that are `used`."""
        distance = (nodes - point.unsqueeze(-2)).norm(dim=-1)
        length = distance.square() if self.squared else distance
        return length.masked_fill(~used | (distance >= self.reach), torch.inf)


class NearestEdges:
    """An edge of plain length to each of the nearest nodes: the graph is connected, at every scale.

    Args:
        count: nodes joined to a new one. Later nodes may join it too, so degrees vary.

    Raises:
        ValueError: a count below 1.
    """

    def __init__(self, count: int = 5) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1 neighbour, got {count}")
        self.count = count

    def __call__(
        self,
        point: Float[Tensor, "*batch D"],
        nodes: Float[Tensor, "*batch C D"],
        used: Bool[Tensor, "*batch C"],
    ) -> Float[Tensor, "*batch C"]:
        """Edges from `point` to those rows of `nodes` that are `used`."""
        distance = (nodes - point.unsqueeze(-2)).norm(dim=-1).masked_fill(~used, torch.inf)
        nearest = distance.topk(min(self.count, distance.shape[-1]), dim=-1, largest=False)
        return torch.full_like(distance, torch.inf).scatter(-1, nearest.indices, nearest.values)
