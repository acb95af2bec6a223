"""Maximisation of the action value over the box of actions: argmax_a Q(s, a) for many states at once.

The posterior mean is compared at candidate actions that all states share, then improved: in one dimension,
on a grid, by the vertex of the parabola through the best candidate and its neighbours; in more dimensions, on
a scrambled Sobol sequence with the corners of the box, by projected gradient ascent from the best candidates.

Where the kernel is a product of one over states and one over actions, as a squared exponential is, the
candidates of all states cost one matrix product, Q(s, a_j) = Σ_b c_b(s) k(a_j, a_b), c_b(s) = α_b k(s, s_b),
instead of a kernel evaluation for each pair.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.quasirandom import SobolEngine

from torch_gprl.critics.action_value import GPActionValue
from torch_gprl.kernels import Kernel, Product, SquaredExponential

MOST_CORNERS = 64  # of the box among the candidates: those of six dimensions; a box of more has none
CHUNK = 2**22  # numbers of the largest temporary: bounds the memory

Value = Callable[[Tensor, Tensor], Tensor]
"""Q at observations [*batch, N, S] and actions [*batch, N, A]: [*batch, N], differentiable in the actions."""


class Maximum(NamedTuple):
    """The best action of each state and its value."""

    action: Float[Tensor, "*batch A"]
    value: Float[Tensor, "*batch"]


class Products(NamedTuple):
    """Covariances of states and of candidate actions with the basis: their products are those of the pairs.

    Valid until the basis, the kernel or the scaling changes; `alpha` may change.
    """

    states: Float[Tensor, "*batch N B"]
    actions: Float[Tensor, "*batch J B"]

    def mean(self, alpha: Float[Tensor, "*batch B"]) -> Float[Tensor, "*batch N J"]:
        """Posterior mean of the process, in its own units, at all pairs of states and candidates."""
        return (self.states * alpha.unsqueeze(-2)) @ self.actions.mT


def factorises(kernel: Kernel, states: int) -> bool:
    """Whether k((s, a), (s', a')) = k(s, s') k(a, a') for the first `states` columns and the others."""
    if isinstance(kernel, Product):
        return all(factorises(part, states) for part in kernel.parts)
    columns = kernel.active_columns
    return isinstance(kernel, SquaredExponential) or max(columns) < states or min(columns) >= states


def candidate_actions(
    low: Float[Tensor, " A"], high: Float[Tensor, " A"], count: int
) -> Float[Tensor, "J A"]:
    """Actions that cover the box [low, high], its corners among them; the same at every call.

    Args:
        low: lower bounds of the box, [A].
        high: upper bounds, [A].
        count: points of the grid in one dimension, or of the Sobol sequence in more, to which up to 64
            corners are added.

    Raises:
        ValueError: fewer than 3 points, or an empty or unbounded box.
    """
    if count < 3:
        raise ValueError(f"maximisation needs at least 3 candidate actions, got {count}")
    if not bool(torch.isfinite(high - low).all() & (low < high).all()):
        raise ValueError(
            f"actions must have finite bounds, the lower below the upper, got {low.tolist()} to "
            f"{high.tolist()}; bound the action spec"
        )
    dims = len(low)
    if dims == 1:
        shares = torch.linspace(0, 1, count, dtype=low.dtype, device=low.device).unsqueeze(-1)
    else:
        shares = SobolEngine(dims, scramble=True, seed=0).draw(count).to(low)
        if 2**dims <= MOST_CORNERS:
            ends = torch.tensor([0.0, 1.0], dtype=low.dtype, device=low.device)
            shares = torch.cat([torch.cartesian_prod(*[ends] * dims), shares])
    return low + shares * (high - low)


def ascend(
    value: Value, observation: Tensor, start: Tensor, low: Tensor, high: Tensor, stride: float, steps: int
) -> Maximum:
    """Projected gradient ascent from `start`, never to a lower value.

    The step length is that of Barzilai and Borwein (1988), the curvature seen between the last two points,
    and at most `stride`; a point that does not gain stays and tries a shorter step.

    Args:
        value: what is maximised.
        observation: [*batch, N, S].
        start: actions [*batch, N, A] within the box.
        low: lower bounds of the box, [A].
        high: upper bounds, [A].
        stride: longest step, in halves of the box.
        steps: how many are tried.
    """
    half, action = (high - low) / 2, start
    best, slope = _value_and_slope(value, observation, action, half)
    rate = stride / _length(slope)
    for _ in range(steps):
        trial = (action + rate * half * slope).clamp(low, high)
        there, slope_there = _value_and_slope(value, observation, trial, half)
        gain = (there > best).unsqueeze(-1)
        # |Δa|² / −Δa·Δ∇Q, which is negative where the function is not concave
        moved = (trial - action) / half
        curvature = -(moved * (slope_there - slope)).sum(-1, keepdim=True)
        secant = moved.square().sum(-1, keepdim=True) / curvature
        longest = torch.where(gain, stride / _length(slope_there), rate / 2)
        action, slope = torch.where(gain, trial, action), torch.where(gain, slope_there, slope)
        best = torch.where(gain.squeeze(-1), there, best)
        rate = torch.where((secant > 0) & (secant < longest), secant, longest)
    return Maximum(action, best)


def _length(slope: Tensor) -> Float[Tensor, "*batch 1"]:
    return slope.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(slope.dtype).tiny)


def _value_and_slope(
    value: Value, observation: Tensor, action: Tensor, half: Tensor
) -> tuple[Tensor, Tensor]:
    """The value and its gradient in the action, per half of the box."""
    with torch.enable_grad():
        leaf = action.detach().requires_grad_()
        result = value(observation, leaf)
        (gradient,) = torch.autograd.grad(result.sum(), leaf)
    return result.detach(), gradient * half


class ActionMaximiser:
    """Finds argmax_a Q(s, a) of a critic's posterior mean within a box of actions.

    Args:
        critic: action value, one process for each learner.
        low: lower bounds of the box, [A], in the units of the critic's actions.
        high: upper bounds, [A].
        candidates: actions compared for every state, see `candidate_actions`.
        starts: how many of the best candidates are improved by gradient steps; more than one dimension.
        steps: gradient steps of each; 0 takes the best candidate as it is, in one dimension too.
    """

    def __init__(
        self,
        critic: GPActionValue,
        low: Tensor,
        high: Tensor,
        candidates: int = 33,
        starts: int = 2,
        steps: int = 8,
    ) -> None:
        like = critic.input_loc
        self.critic, self.starts, self.steps = critic, starts, steps
        self.low, self.high = low.to(like), high.to(like)
        self.candidates = candidate_actions(self.low, self.high, candidates)
        kernel = critic.gp.kernel
        self._factorises = factorises(kernel, kernel.input_dim - len(low))
        self.stride = 2 / candidates ** (1 / len(low))  # between candidates, in halves of the box

    @torch.no_grad()
    def __call__(
        self,
        observation: Float[Tensor, "*batch S"],
        given: Float[Tensor, "*batch J A"] | None = None,
    ) -> Maximum:
        """The best actions at observations [learners, ..., S], in the critic's dtype.

        Args:
            observation: states; leading dimensions are those of the critic's process.
            given: more candidates for each state, within the box, such as the actions of a policy.
        """
        shape, batch = observation.shape[:-1], self.critic.gp.batch_shape
        states = observation.reshape(*batch, -1, observation.shape[-1])
        more = None if given is None else given.reshape(*states.shape[:-1], *given.shape[-2:]).to(self.low)
        parts = [
            self._maximise(states[..., rows, :], None if more is None else more[..., rows, :, :])
            for rows in self._chunks(states.shape[-2])
        ]
        action = torch.cat([part.action for part in parts], -2)
        value = torch.cat([part.value for part in parts], -1)
        return Maximum(action.reshape(*shape, -1), value.reshape(shape))

    def _chunks(self, points: int) -> list[slice]:
        """Slices of so many states as the memory is meant to hold."""
        gp = self.critic.gp
        each = gp.batch_shape.numel() * gp.capacity
        if not self._factorises:
            each *= len(self.candidates)
        size = max(1, CHUNK // each)
        return [slice(start, start + size) for start in range(0, max(points, 1), size)]

    def _maximise(self, states: Tensor, given: Tensor | None) -> Maximum:
        values = self.candidate_values(states)
        if not self.steps:
            best, index = values.max(-1)
            found = Maximum(self.candidates[index], best)
        elif len(self.low) == 1:
            found = self._vertex(values)
        else:
            found = self._climb(states, values, given)
            given = None
        if given is None:
            return found
        spread = states.unsqueeze(-2).expand(*given.shape[:-1], -1)
        best, index = self.critic.mean_value(spread, given).max(-1)
        action = given.take_along_dim(index[..., None, None], -2).squeeze(-2)
        gain = best > found.value
        return Maximum(
            torch.where(gain.unsqueeze(-1), action, found.action), torch.where(gain, best, found.value)
        )

    # ---------------------------------------------------------------- candidates

    def products(self, observation: Float[Tensor, "*batch N S"]) -> Products:
        """Covariances of states and candidates with the basis, for a kernel that `factorises`."""
        critic, kernel = self.critic, self.critic.gp.kernel
        actions = len(self.low)
        nowhere = self.candidates.new_zeros(
            *critic.gp.batch_shape, len(self.candidates), observation.shape[-1]
        )
        tried = critic.inputs(nowhere, self.candidates.expand(*nowhere.shape[:-1], -1))
        seen = critic.inputs(observation, self.low.expand(*observation.shape[:-1], -1))
        state_columns = torch.arange(seen.shape[-1], device=seen.device) < seen.shape[-1] - actions
        basis = critic.gp.basis
        # columns that are equal leave nothing of their factor but its variance
        by_state = kernel(seen * state_columns, basis * state_columns)
        by_action = kernel(tried * ~state_columns, basis * ~state_columns)
        return Products(by_state, by_action / kernel.diag(tried).unsqueeze(-1))

    def candidate_values(self, states: Float[Tensor, "*batch N S"]) -> Float[Tensor, "*batch N J"]:
        """Q of all candidates at states [*batch, N, S]."""
        if self._factorises:
            mean = self.products(states).mean(self.critic.gp.alpha)
            loc, scale = self.critic.target_loc, self.critic.target_scale
            return loc[..., None, None] + scale[..., None, None] * mean
        pairs = (*states.shape[:-1], len(self.candidates))
        spread = states.unsqueeze(-2).expand(*pairs, -1)
        return self.critic.mean_value(spread, self.candidates.expand(*pairs, -1))

    # ---------------------------------------------------------------- improvement

    def _vertex(self, values: Float[Tensor, "*batch N J"]) -> Maximum:
        """The vertex of the parabola through the best point of the grid and its neighbours."""
        best, index = values.max(-1)
        inner = index.clamp(1, values.shape[-1] - 2)
        left, middle, right = (
            values.gather(-1, (inner + shift).unsqueeze(-1)).squeeze(-1) for shift in (-1, 0, 1)
        )
        curvature = left - 2 * middle + right
        peaked = (curvature < 0) & (index == inner)  # the best of a flat stretch, or at a bound, stays
        offset = torch.where(peaked, 0.5 * (left - right) / torch.where(peaked, curvature, 1.0), 0.0)
        spacing = self.candidates[1] - self.candidates[0]
        action = self.candidates[index] + offset.unsqueeze(-1) * spacing
        return Maximum(action, best - 0.25 * (left - right) * offset)

    def _climb(self, states: Tensor, values: Tensor, given: Tensor | None) -> Maximum:
        """Gradient ascent from the best candidates."""
        starts = self.candidates[values.topk(min(self.starts, values.shape[-1]), -1).indices]
        if given is not None:
            starts = torch.cat([starts, given], -2)
        spread = states.unsqueeze(-2).expand(*starts.shape[:-1], -1)
        ends = ascend(self.critic.mean_value, spread, starts, self.low, self.high, self.stride, self.steps)
        best, index = ends.value.max(-1)
        action = ends.action.take_along_dim(index[..., None, None], -2).squeeze(-2)
        return Maximum(action, best)
