"""What a robot has seen, as a graph: visited states, and the transitions that lead from each to the next.

A stored transition x → x' also tells where inputs near x go: to x' + J (x − x_i), with J the slope of the
transitions around it (locally weighted linear regression: Atkeson, Moore and Schaal, 1997). So every input
has a successor, and the graph reaches beyond its own vertices. Inputs are what the caller makes of states, or
of states and actions: scaled, and angles as (cos, sin).

Which states are neighbours depends on the units of each column. Those that suit values follow from the length
scales ℓ of an ordinary kernel of values, pulled back along the flow: with J_k = ∂x_{t+k}/∂x_t,

    1/ℓ̃_d² = max_k median_t γ^{2k} Σ_e (J_k)_ed² / ℓ_e².

A column that values forgive counts for as much as it moves those that they do not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torch_gprl.graphs.covering import farthest_points
from torch_gprl.graphs.interpolation import COINCIDENT, Neighbours, gather_rows, neighbours

SLOPE_RIDGE = 1e-3  # of the squared reach of the neighbours: keeps slopes finite along directions never tried


class Successor(NamedTuple):
    """Where each input is expected to go in one step."""

    point: Float[Tensor, "*batch N D"]
    alive: Float[Tensor, "*batch N"]  # weight of the neighbours that did not end there


class Experience(nn.Module):
    """The newest transitions of each learner, in buffers of fixed size.

    Args:
        input_dim: columns of an input.
        capacity: transitions kept; the oldest go first.
        landmarks: vertices, spread out over all, that stand for the others where there are too many.
        interpolate: nearest transitions that speak for an input.
        slope_neighbours: transitions whose differences give the slope at one.
        batch_shape: independent learners. All add the same number of transitions.

    Raises:
        ValueError: a number that is out of its range.
    """

    states: Float[Tensor, "*batch C D"]
    next_states: Float[Tensor, "*batch C D"]
    terminated: Bool[Tensor, "*batch C"]
    slopes: Float[Tensor, "*batch C D D"]
    after_nodes: Int[Tensor, "*batch C K"]  # where each transition arrives: vertices and their weights
    after_weights: Float[Tensor, "*batch C K"]
    ends: Bool[Tensor, "*batch C"]  # no stored transition starts where this one arrives
    landmarks: Int[Tensor, "*batch L"]
    lengthscale: Float[Tensor, "*batch D"]  # units in which distances between inputs are measured
    size: Int[Tensor, ""]

    def __init__(
        self,
        input_dim: int,
        capacity: int,
        landmarks: int = 128,
        interpolate: int = 8,
        slope_neighbours: int = 20,
        batch_shape: Sequence[int] = (),
    ) -> None:
        super().__init__()
        if not 1 <= interpolate < capacity:
            raise ValueError(
                f"interpolate must be at least 1 and below the capacity {capacity}, got {interpolate}"
            )
        if not 1 <= slope_neighbours <= capacity:
            raise ValueError(
                f"slope_neighbours must be from 1 to the capacity {capacity}, got {slope_neighbours}"
            )
        if not 1 <= landmarks <= capacity:
            raise ValueError(f"landmarks must be from 1 to the capacity {capacity}, got {landmarks}")
        self.capacity = capacity
        self.interpolate = interpolate
        self.slope_neighbours = slope_neighbours
        batch = torch.Size(batch_shape)
        points = torch.zeros(*batch, capacity, input_dim, dtype=torch.float64)
        self.register_buffer("states", points)
        self.register_buffer("next_states", points.clone())
        self.register_buffer("terminated", torch.zeros(*batch, capacity, dtype=torch.bool))
        self.register_buffer("slopes", points.new_zeros(*batch, capacity, input_dim, input_dim))
        self.register_buffer("after_nodes", torch.zeros(*batch, capacity, interpolate, dtype=torch.long))
        self.register_buffer("after_weights", points.new_zeros(*batch, capacity, interpolate))
        self.register_buffer("ends", torch.zeros(*batch, capacity, dtype=torch.bool))
        self.register_buffer("landmarks", torch.zeros(*batch, landmarks, dtype=torch.long))
        self.register_buffer("lengthscale", points.new_ones(*batch, input_dim))
        self.register_buffer("size", torch.zeros((), dtype=torch.long))

    @property
    def mask(self) -> Bool[Tensor, " C"]:
        """Which rows hold a transition."""
        return torch.arange(self.capacity, device=self.size.device) < self.size

    @torch.no_grad()
    def add(
        self,
        states: Float[Tensor, "*batch N D"],
        next_states: Float[Tensor, "*batch N D"],
        terminated: Bool[Tensor, "*batch N"] | None = None,
    ) -> None:
        """Store transitions, then renew slopes, links and landmarks; the oldest make room.

        Costs O(capacity²) distances: add whole batches of trajectories.

        Args:
            states: x [*batch, N, D].
            next_states: x' [*batch, N, D]. Equal to the next row of `states` inside a trajectory; where it
                equals none, as at a time limit, the graph goes on at the vertices nearest to it.
            terminated: where the episode ended, and the value beyond is 0 [*batch, N]; nowhere unless told.
        """
        if terminated is None:
            terminated = torch.zeros(states.shape[:-1], dtype=torch.bool, device=self.size.device)
        held, new = int(self.size), states.shape[-2]
        kept = slice(max(0, held + new - self.capacity), held)
        for buffer, values in (
            (self.states, states),
            (self.next_states, next_states),
            (self.terminated.unsqueeze(-1), terminated.unsqueeze(-1)),
        ):
            together = torch.cat([buffer[..., kept, :], values.to(buffer)], -2)[..., -self.capacity :, :]
            buffer[..., : together.shape[-2], :] = together
        self.size.fill_(min(held + new, self.capacity))
        self._renew()

    @torch.no_grad()
    def measure(self, lengthscale: Float[Tensor, "*#batch D"]) -> None:
        """Measure distances between inputs in these units from now on; slopes, links and landmarks follow."""
        self.lengthscale.copy_(lengthscale)
        self._renew()

    @torch.no_grad()
    def pulled_back(
        self, lengthscale: Float[Tensor, "*#batch D"], discount: float, steps: int = 10
    ) -> Float[Tensor, "*batch D"]:
        """Length scales ℓ̃ of states for values that vary over `lengthscale`, see the top of this file.

        Without experience they are those of the values.

        Args:
            lengthscale: ℓ of an ordinary kernel of values [*batch, D], in units of the inputs.
            discount: γ.
            steps: most steps k that are looked ahead.
        """
        used = slice(int(self.size))
        slopes, after = self.slopes[..., used, :, :], self.after_nodes[..., used, :1]
        weight = lengthscale.expand(self.lengthscale.shape).reciprocal().square()
        if int(self.size) == 0:
            return weight.rsqrt()
        flow, node, most = slopes, after, weight
        for step in range(1, steps + 1):
            moved = (flow.square() * weight[..., None, :, None]).sum(-2)
            most = torch.maximum(most, discount ** (2 * step) * moved.median(-2).values)
            here = gather_rows(slopes.flatten(-2), node).squeeze(-2).unflatten(-1, slopes.shape[-2:])
            flow, node = here @ flow, gather_rows(after, node).squeeze(-1)
        return most.rsqrt()

    def _renew(self) -> None:
        """Slopes, links and landmarks of all that is stored."""
        used = slice(int(self.size))
        self.slopes[..., used, :, :] = self._local_slopes(
            self.states[..., used, :], self.next_states[..., used, :]
        )
        after = self.nearest(self.next_states[..., used, :])
        self.after_nodes[..., used, :] = after.nodes
        self.after_weights[..., used, :] = after.weight
        self.ends[..., used] = (after.distance[..., 0] > COINCIDENT) & ~self.terminated[..., used]
        points = self.states[..., used, :] / self.lengthscale.unsqueeze(-2)
        chosen = farthest_points(points, self.landmarks.shape[-1]).chosen
        # some twice if there are too few
        self.landmarks.copy_(chosen[..., torch.arange(self.landmarks.shape[-1]) % chosen.shape[-1]])

    def without_folds(self, count: int, way: int = 0) -> list[Bool[Tensor, "*batch C"]]:
        """All transitions but those of one fold of the trajectories, for each of `count` folds.

        Where nothing else is left, all transitions. A trajectory goes on where half of the columns of a row
        are those that the row before it arrives at: a graph of states and actions stores the policy's action
        there, not the one that was taken.

        Args:
            count: folds.
            way: to divide into folds, by this digit of the trajectories' numbers to the base `count`; so any
                two folds of different ways have as little as can be in common.
        """
        same = self.next_states[..., :-1, :] == self.states[..., 1:, :]
        number = nn.functional.pad((same.double().mean(-1) < 0.5).cumsum(-1), (1, 0))
        digit = number // count**way % count
        kept = [self.mask & (digit != fold) for fold in range(count)]
        return [torch.where(some.any(-1, keepdim=True), some, self.mask) for some in kept]

    def nearest(
        self, x: Float[Tensor, "*#batch N D"], among: Bool[Tensor, "*#batch C"] | None = None
    ) -> Neighbours:
        """The visited states that speak for x [*batch, N, D]; of those in `among`, if given."""
        units, used = self.lengthscale.unsqueeze(-2), self.mask if among is None else among
        return neighbours(x / units, self.states / units, used, self.interpolate)

    def successor(
        self, x: Float[Tensor, "*#batch N D"], among: Bool[Tensor, "*#batch C"] | None = None
    ) -> Successor:
        """Where x [*batch, N, D] is expected to go: x' of its neighbours, corrected by their slopes."""
        found = self.nearest(x, among)
        offset = x.unsqueeze(-2) - gather_rows(self.states, found.nodes)
        slopes = gather_rows(self.slopes.flatten(-2), found.nodes).unflatten(-1, self.slopes.shape[-2:])
        arrivals = gather_rows(self.next_states, found.nodes) + (slopes @ offset.unsqueeze(-1)).squeeze(-1)
        ended = gather_rows(self.terminated.unsqueeze(-1), found.nodes).squeeze(-1)
        return Successor((found.weight.unsqueeze(-1) * arrivals).sum(-2), (found.weight * ~ended).sum(-1))

    def _local_slopes(self, states: Tensor, next_states: Tensor) -> Tensor:
        """J at every state: regression of the differences of x' on those of x, the nearest weighing most."""
        units = self.lengthscale.unsqueeze(-2)
        states, next_states = states / units, next_states / units
        everywhere = torch.ones(states.shape[:-1], dtype=torch.bool, device=states.device)
        near = neighbours(states, states, everywhere, min(self.slope_neighbours + 1, states.shape[-2]))
        reach = near.distance[..., -1:].clamp_min(COINCIDENT)
        weight = (1 - (near.distance / (reach * 1.001)).pow(3)).pow(3).unsqueeze(-1)  # tricube
        # the slope of the displacement x' − x: the ridge then draws towards "as the neighbour moved"
        X = gather_rows(states, near.nodes) - states.unsqueeze(-2)
        Y = gather_rows(next_states, near.nodes) - next_states.unsqueeze(-2) - X
        eye = torch.eye(states.shape[-1], dtype=states.dtype, device=states.device)
        ridge = SLOPE_RIDGE * (weight.sum(-2) * reach.square()).unsqueeze(-1) * eye
        slope = torch.linalg.solve((weight * X).mT @ X + ridge, (weight * X).mT @ Y)
        return (slope.mT + eye) * units.mT.unsqueeze(-3) / units.unsqueeze(-3)
