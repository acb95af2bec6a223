"""Lengths of shortest paths between all pairs of nodes, kept exact while a graph changes.

A new node or edge costs O(n²): every path is the old one, or goes through what is new (the min-plus algebra
of Carré, 1971). Taking a node away needs Dijkstra from the nodes whose paths went through it, and from no
other. Infinite where there is no path.
"""

import torch
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

Paths = Float[Tensor, "*batch C C"]
TOLERANCE = 1e-9  # relative: a path this close to the sum of two others may go through their common node


def paths_of_new_node(paths: Paths, lengths: Float[Tensor, "*batch C"]) -> Float[Tensor, "*batch C"]:
    """Shortest paths from a new node with edges of `lengths` to every old one."""
    return (lengths.unsqueeze(-1) + paths).amin(-2)  # min_i (ℓ_i + P_ij)


def shorten_through(paths: Paths, to_node: Float[Tensor, "*batch C"]) -> Paths:
    """Paths that may now go through a node, from the paths of that node."""
    return torch.minimum(paths, to_node.unsqueeze(-1) + to_node.unsqueeze(-2))


def shorten_by_edge(
    paths: Paths,
    first: Float[Tensor, "*batch C"],
    second: Float[Tensor, "*batch C"],
    length: Float[Tensor, "*batch"],
) -> Paths:
    """Paths that may now use an edge, from the paths of its two ends."""
    there = first.unsqueeze(-1) + (length[..., None, None] + second.unsqueeze(-2))
    return torch.minimum(paths, torch.minimum(there, there.mT))


def paths_from(lengths: Float[Tensor, "C C"], sources: Bool[Tensor, " C"]) -> Float[Tensor, "S C"]:
    """Dijkstra from some nodes, in a graph of edge lengths that are infinite where there is no edge.

    Edges between copies of one point have length 0: they count.
    """
    rows, columns = lengths.isfinite().nonzero(as_tuple=True)
    off = rows != columns
    rows, columns = rows[off], columns[off]
    edges = (lengths[rows, columns].cpu().numpy(), (rows.cpu().numpy(), columns.cpu().numpy()))
    graph = csr_array(edges, shape=tuple(lengths.shape))
    found = dijkstra(graph, directed=True, indices=sources.nonzero().flatten().cpu().numpy())
    return torch.from_numpy(found).to(lengths).reshape(-1, lengths.shape[-1])


def sources_through(paths: Float[Tensor, "C C"], gone: Bool[Tensor, " C"]) -> Bool[Tensor, " C"]:
    """Nodes of which some shortest path may go through a node that is gone."""
    affected = torch.zeros_like(gone)
    for node in gone.nonzero().flatten():
        through = paths[:, node].unsqueeze(-1) + paths[node].unsqueeze(-2)
        uses = through.isfinite() & (through <= paths * (1 + TOLERANCE) + TOLERANCE)
        uses[:, gone] = False
        affected |= uses.fill_diagonal_(False).any(-1)
    return affected & ~gone
