"""The graph of experience, equation (.18): nodes in state-action space, edges, and all their shortest paths.

One graph per learner in buffers of fixed size, so that a kernel on it is saved, moved and sent to workers
like any other module. Shortest paths stay exact through every change. Inputs are what the caller makes of
states: scaled, and angles as (cos, sin).

| paper | here | meaning |
|---|---|---|
| x_i | `points` | nodes, rows of zeros where unused |
| E | `lengths` | edge lengths, infinite where there is no edge, 0 on the diagonal of used rows |
| P | `paths` | lengths of shortest paths, infinite between components |
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torch_gprl.graphs.edges import EdgeRule, NearestEdges
from torch_gprl.graphs.paths import (
    paths_from,
    paths_of_new_node,
    shorten_by_edge,
    shorten_through,
    sources_through,
)


class TransitionGraph(nn.Module):
    """Nodes, edges and the lengths of all shortest paths, for each learner of a batch.

    Args:
        input_dim: columns of a node.
        capacity: most nodes of a graph.
        edges: which old nodes a new one is joined to; `NearestEdges()` unless told.
        batch_shape: independent graphs.
    """

    points: Float[Tensor, "*batch C D"]
    lengths: Float[Tensor, "*batch C C"]
    paths: Float[Tensor, "*batch C C"]
    size: Int[Tensor, "*batch"]

    def __init__(
        self, input_dim: int, capacity: int, edges: EdgeRule | None = None, batch_shape: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.capacity = capacity
        self.edges: EdgeRule = NearestEdges() if edges is None else edges
        batch = torch.Size(batch_shape)
        unconnected = torch.full((*batch, capacity, capacity), torch.inf, dtype=torch.float64)
        self.register_buffer("points", torch.zeros(*batch, capacity, input_dim, dtype=torch.float64))
        self.register_buffer("lengths", unconnected.clone())
        self.register_buffer("paths", unconnected)
        self.register_buffer("size", torch.zeros(batch, dtype=torch.long))

    @property
    def mask(self) -> Bool[Tensor, "*batch C"]:
        """Which rows are nodes."""
        return torch.arange(self.capacity, device=self.size.device) < self.size.unsqueeze(-1)

    @torch.no_grad()
    def add(self, points: Float[Tensor, "*batch N D"], mask: Bool[Tensor, "*batch N"] | None = None) -> None:
        """Add nodes one after the other, each joined to older ones by the edge rule; O(N · capacity²).

        Args:
            points: [*batch, N, D].
            mask: which of them to add; all unless told.

        Raises:
            ValueError: more nodes than the capacity; nothing was added then.
        """
        count = mask.sum(-1) if mask is not None else torch.full_like(self.size, points.shape[-2])
        largest = int((self.size + count).max())
        if largest > self.capacity:
            raise ValueError(
                f"the graph holds at most {self.capacity} nodes, got {largest}; eliminate some, or make it "
                "larger"
            )
        for i in range(points.shape[-2]):
            wanted = torch.ones_like(self.size, dtype=torch.bool) if mask is None else mask[..., i]
            self._add_one(points[..., i, :].to(self.points), wanted)

    def _add_one(self, point: Tensor, wanted: Tensor) -> None:
        lengths = self.edges(point, self.points, self.mask)
        lengths = lengths.masked_fill(~wanted.unsqueeze(-1), torch.inf)
        rows = torch.arange(self.capacity, device=self.size.device)
        slot = (rows == self.size.unsqueeze(-1)) & wanted.unsqueeze(-1)  # [*batch, C], one True or none
        to_new = paths_of_new_node(self.paths, lengths)
        self.paths.copy_(shorten_through(self.paths, to_new))
        _write_node(self.lengths, slot, lengths)
        _write_node(self.paths, slot, to_new)
        self.points.copy_(torch.where(slot.unsqueeze(-1), point.unsqueeze(-2), self.points))
        self.size.add_(wanted)

    @torch.no_grad()
    def connect(
        self,
        first: Int[Tensor, "*batch E"],
        second: Int[Tensor, "*batch E"],
        length: Float[Tensor, "*batch E"],
    ) -> None:
        """Join pairs of nodes, such as successive ones on a trajectory; the shorter of two edges counts.

        Args:
            first: numbers of nodes [*batch, E].
            second: numbers of their partners [*batch, E].
            length: [*batch, E]; infinite for no edge.

        Raises:
            ValueError: a number that is no node, or a negative length.
        """
        ends = torch.stack((first, second))
        if bool(((ends < 0) | (ends >= self.size.unsqueeze(-1))).any()) or bool((length < 0).any()):
            raise ValueError("edges need numbers of nodes in use, and lengths of at least 0")
        rows = torch.arange(self.capacity, device=self.size.device)
        for edge in range(first.shape[-1]):
            i, j, new = first[..., edge, None], second[..., edge, None], length[..., edge].to(self.paths)
            here, there = rows == i, rows == j
            self.lengths.copy_(_join(self.lengths, here, there, new))
            from_i = self.paths.masked_fill(~here.unsqueeze(-1), torch.inf).amin(-2)
            from_j = self.paths.masked_fill(~there.unsqueeze(-1), torch.inf).amin(-2)
            self.paths.copy_(shorten_by_edge(self.paths, from_i, from_j, new))

    @torch.no_grad()
    def eliminate(self, gone: Bool[Tensor, "*batch C"]) -> None:
        """Take nodes away and keep the paths through them, as edges between their neighbours.

        What is left has the distances that it had: experience stays when a node goes.
        """
        gone = gone & self.mask
        for node in gone.reshape(-1, self.capacity).any(0).nonzero().flatten():
            its = self.lengths[..., node].masked_fill(~gone[..., node, None], torch.inf)
            self.lengths.copy_(torch.minimum(self.lengths, its.unsqueeze(-1) + its.unsqueeze(-2)))
        self._compact(gone)

    @torch.no_grad()
    def remove(self, gone: Bool[Tensor, "*batch C"]) -> None:
        """Take nodes away with all paths through them; Dijkstra anew from the nodes that had such paths."""
        gone = gone & self.mask
        kept = torch.where(_pairs(~gone), self.lengths, torch.inf)
        for lengths, paths, lost in zip(
            *map(self._flat, (kept, self.paths)), gone.view(-1, self.capacity), strict=True
        ):
            sources = sources_through(paths, lost)
            if bool(sources.any()):
                found = paths_from(lengths, sources)
                paths[sources] = found
                paths[:, sources] = found.mT
        self._compact(gone)

    def _flat(self, matrix: Tensor) -> Tensor:
        """One batch dimension in all, as a view."""
        return matrix.view(-1, self.capacity, self.capacity)

    def _compact(self, gone: Tensor) -> None:
        """Move the nodes that stay to the front, in their order."""
        stays = self.mask & ~gone
        order = (~stays).to(torch.int8).argsort(dim=-1, stable=True)
        size = stays.sum(-1)
        used = torch.arange(self.capacity, device=size.device) < size.unsqueeze(-1)
        for matrix in (self.lengths, self.paths):
            moved = matrix.gather(-2, order.unsqueeze(-1).expand_as(matrix))
            moved = moved.gather(-1, order.unsqueeze(-2).expand_as(matrix))
            matrix.copy_(torch.where(_pairs(used), moved, torch.inf))
        points = self.points.gather(-2, order.unsqueeze(-1).expand_as(self.points))
        self.points.copy_(points * used.unsqueeze(-1))
        self.size.copy_(size)

    @torch.no_grad()
    def follow(self, points: Float[Tensor, "*batch N D"], mask: Bool[Tensor, "*batch N"]) -> None:
        """Have just these nodes, such as the basis of a Gaussian process: eliminate others, add the new."""
        points = points.to(self.points)
        same = (self.points.unsqueeze(-2) == points.unsqueeze(-3)).all(-1)  # [*batch, C, N]
        same &= self.mask.unsqueeze(-1) & mask.unsqueeze(-2)
        gone = self.mask & ~same.any(-1)
        new = mask & ~same.any(-2)
        if bool(gone.any()):
            self.eliminate(gone)
        if bool(new.any()):
            wanted = new.reshape(-1, new.shape[-1]).any(0)
            self.add(points[..., wanted, :], new[..., wanted])

    def components(self) -> Int[Tensor, "*batch"]:
        """Number of parts with no path between them."""
        first = self.paths.isfinite().to(torch.int8).argmax(-1)  # the smallest node that one can reach
        return (self.mask & (first == torch.arange(self.capacity, device=first.device))).sum(-1)

    def degrees(self) -> Int[Tensor, "*batch C"]:
        """Number of edges at each node."""
        return (self.lengths.isfinite().sum(-1) - 1) * self.mask


def _write_node(matrix: Tensor, slot: Tensor, row: Tensor) -> None:
    row = torch.where(slot, torch.zeros_like(row), row)
    matrix.copy_(torch.where(slot.unsqueeze(-1), row.unsqueeze(-2), matrix))
    matrix.copy_(torch.where(slot.unsqueeze(-2), row.unsqueeze(-1), matrix))


def _join(lengths: Tensor, here: Tensor, there: Tensor, new: Tensor) -> Tensor:
    edge = here.unsqueeze(-1) & there.unsqueeze(-2)
    return torch.where(edge | edge.mT, torch.minimum(lengths, new[..., None, None]), lengths)


def _pairs(mask: Tensor) -> Tensor:
    return mask.unsqueeze(-1) & mask.unsqueeze(-2)
