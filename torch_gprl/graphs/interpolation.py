"""Where an input stands among the nodes of a graph: its nearest nodes, and the weights of each.

Weights are those of Franke and Little's form of Shepard's method (Shepard, 1968; Franke and Nielson, 1980):
w ∝ (1/d − 1/R)² with R the distance of the first node that is left out, so that they change continuously as
nodes enter and leave. A node itself gets all weight; one neighbour is the nearest node, equation (.20).
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import KDTree
from torch import Tensor

COINCIDENT = 1e-9  # an input this close to a node, in units of the inputs, is the node
CHUNK = 1024  # inputs whose distances to all nodes are held at a time
TREE_COLUMNS = 6  # up to which a tree beats comparing all distances: 17 times with 3 columns, 4 with 5
TREE_INPUTS = 32  # from which on a tree is worth growing


class Neighbours(NamedTuple):
    """The nearest nodes of each input, nearest first; weight 0, distance infinite where too few."""

    nodes: Int[Tensor, "*batch N K"]
    distance: Float[Tensor, "*batch N K"]
    weight: Float[Tensor, "*batch N K"]

    def average(self, values: Float[Tensor, "*#batch C R"]) -> Float[Tensor, "*batch N R"]:
        """Weighted average of what the nodes hold, [*batch, C, R]."""
        return (self.weight.unsqueeze(-1) * gather_rows(values, self.nodes)).sum(-2)


def neighbours(
    x: Float[Tensor, "*#batch N D"],
    nodes: Float[Tensor, "*#batch C D"],
    used: Bool[Tensor, "*#batch C"],
    count: int,
) -> Neighbours:
    """Find the `count` nearest of the nodes in use, with their weights; differentiable in x and nodes.

    Args:
        x: inputs [*batch, N, D].
        nodes: [*batch, C, D].
        used: which rows are nodes [*batch, C].
        count: neighbours of each input, at most C − 1.
    """
    with torch.no_grad():
        small = x.shape[-1] <= TREE_COLUMNS and x.shape[-2] >= TREE_INPUTS
        find = _nearest_by_trees if small and x.device.type == "cpu" else _nearest_of_all
        index, missing = find(x.detach(), nodes.detach(), used, min(count + 1, nodes.shape[-2]))
    # the matrix products of cdist round nearby points apart
    distance = (x.unsqueeze(-2) - gather_rows(nodes, index)).norm(dim=-1).masked_fill(missing, torch.inf)
    near, reach = distance[..., :count], distance[..., count:]
    return Neighbours(index[..., :count], near, _shepard_weights(near, reach))


def _nearest_of_all(x: Tensor, nodes: Tensor, used: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Indices of the nearest nodes [*batch, N, count], and which of them are not in use."""
    index, missing = [], []
    for part in x.split(CHUNK, -2):
        rough = torch.cdist(part, nodes).masked_fill(~used.unsqueeze(-2), torch.inf)
        nearest = rough.topk(count, dim=-1, largest=False)
        index.append(nearest.indices)
        missing.append(nearest.values.isinf())
    return torch.cat(index, -2), torch.cat(missing, -2)


def _nearest_by_trees(x: Tensor, nodes: Tensor, used: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The same, by a tree of each learner's nodes."""
    batch = torch.broadcast_shapes(x.shape[:-2], nodes.shape[:-2], used.shape[:-1])
    learners = (
        tensor.expand(*batch, *shape).reshape(-1, *shape)
        for tensor, shape in ((x, x.shape[-2:]), (nodes, nodes.shape[-2:]), (used, used.shape[-1:]))
    )
    found = []
    for points, places, mask in zip(*learners, strict=True):
        number = mask.nonzero().squeeze(-1).numpy()
        _, rank = KDTree(places.numpy()[number]).query(points.numpy(), count)
        rank = rank.reshape(len(points), count)  # one neighbour comes without its dimension
        found.append(torch.from_numpy(np.append(number, -1)[rank]))  # past the last: there is none
    index = torch.stack(found).reshape(*batch, x.shape[-2], count)
    return index.clamp_min(0), index < 0


def _shepard_weights(distance: Tensor, reach: Tensor) -> Tensor:
    safe = distance.clamp_min(COINCIDENT)
    nearest = safe[..., :1].clamp_max(1 / COINCIDENT)
    # a little more than R, lest all weights vanish where all nodes are equally far
    beyond = nearest / (reach.clamp_min(COINCIDENT) * (1 + 1e-6)) if reach.shape[-1] else 0.0
    weight = (nearest / safe - beyond).clamp_min(0).square()
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)


def gather_rows(values: Shaped[Tensor, "..."], index: Int[Tensor, "..."]) -> Shaped[Tensor, "..."]:
    """Rows [*batch, N, K, R] of values [*batch, C, R] at index [*batch, N, K]; batches broadcast."""
    batch = torch.broadcast_shapes(values.shape[:-2], index.shape[:-2])
    width, flat = values.shape[-1], index.expand(*batch, *index.shape[-2:]).flatten(-2)
    rows = values.expand(*batch, *values.shape[-2:]).gather(-2, flat.unsqueeze(-1).expand(*flat.shape, width))
    return rows.unflatten(-2, index.shape[-2:])
