"""Distances along experience: from landmarks to all visited states, by edges in space and in time.

Neighbouring states are joined by edges of their distance in units of a length scale, successive states by
edges of ln(1/γ). Under exp(−distance) the values of successive states then correlate by the discount γ, as
Bellman's equation has it, however far apart they lie. On trajectories that only merge, this is exactly the
prior of V = r + γV' with white rewards.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor


class Geodesics(NamedTuple):
    """Shortest paths from landmarks to all vertices; infinite where there is none."""

    distance: Float[Tensor, "L C"]
    steps: Float[Tensor, "L C"]  # edges in time on each path


class Edges(NamedTuple):
    """Undirected edges, each once: the shorter where two vertices are joined twice."""

    key: NDArray[np.int64]  # first · vertices + second, first < second, ascending
    length: NDArray[np.float64]
    temporal: NDArray[np.bool_]


def geodesics(
    spatial: tuple[Int[Tensor, "C K"], Float[Tensor, "C K"]],
    temporal: Int[Tensor, "T 2"],
    step_length: float,
    landmarks: Int[Tensor, " L"],
) -> Geodesics:
    """Dijkstra from the landmarks over the visited states.

    Args:
        spatial: neighbours of each vertex and the lengths of the edges to them.
        temporal: pairs of successive vertices.
        step_length: of an edge in time, ln(1/γ) in units in which correlation falls to 1/e.
        landmarks: numbers of vertices.
    """
    vertices = spatial[0].shape[0]
    edges = _undirected(spatial, temporal, step_length)
    ends = edges.key // vertices, edges.key % vertices
    graph = csr_array((edges.length, ends), shape=(vertices, vertices))
    sources = landmarks.cpu().numpy()
    distance, before = dijkstra(graph, directed=False, indices=sources, return_predecessors=True)
    steps = _temporal_edges_on_paths(edges, before.astype(np.int64), vertices)
    like = spatial[1]
    return Geodesics(torch.from_numpy(distance).to(like), torch.from_numpy(steps).to(like))


def _undirected(spatial: tuple[Tensor, Tensor], temporal: Tensor, step_length: float) -> Edges:
    nodes, length = (tensor.detach().cpu().numpy() for tensor in spatial)
    first = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    pairs = np.concatenate([np.stack([first, nodes.ravel()], -1), temporal.cpu().numpy()])
    lengths = np.concatenate([length.ravel(), np.full(len(temporal), step_length)])
    is_temporal = np.arange(len(pairs)) >= first.size
    real = (pairs[:, 0] != pairs[:, 1]) & np.isfinite(lengths)
    key = pairs.min(-1) * len(nodes) + pairs.max(-1)
    order = np.lexsort((lengths, key))
    order = order[real[order]]
    key, chosen = np.unique(key[order], return_index=True)
    return Edges(key, lengths[order][chosen], is_temporal[order][chosen])


def _temporal_edges_on_paths(edges: Edges, before: NDArray[np.int64], vertices: int) -> NDArray[np.float64]:
    """Edges in time between each vertex and the root of its tree, by doubling the way that is covered."""
    here = np.broadcast_to(np.arange(vertices), before.shape)
    rooted = before < 0  # landmarks, and what they cannot reach
    parent = np.where(rooted, here, before)
    key = np.minimum(here, parent) * vertices + np.maximum(here, parent)
    place = np.searchsorted(edges.key, key).clip(max=max(len(edges.key) - 1, 0))
    steps = np.where(rooted, 0.0, edges.temporal[place] if len(edges.key) else 0.0)
    while True:
        further = np.take_along_axis(parent, parent, 1)
        steps = steps + np.take_along_axis(steps, parent, 1)
        if np.array_equal(further, parent):
            return steps
        parent = further
