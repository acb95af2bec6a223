"""A smooth policy, rehearsed in imagination: gradients through the learned model improve it.

The best action of a plan errs where many actions are worth nearly the same, and is another one after every
plan. So what is performed is a regression of actions on states, whose targets y climb what walks through the
model earn, with the plan's value of where they get to:

    π(s) = k(s, Z) (K + σ² I)⁻¹ y,   J(y) = Σ_walks [Σ_{t<T} γᵗ r̂(s_t, π(s_t)) + γᵀ V(s_T)]

A walk goes on as likely as the model sees no end. Deisenroth and Rasmussen (2011) improve such a policy
without values; Heess et al. (2015) with values, one step at a time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.kernels import Linear, SquaredExponential
from torch_gprl.linalg import cholesky

WIDTH = 0.7  # of the policy's bumps, in standard deviations of the observations times √columns
SLOPE = 0.25  # prior variance of its slopes: straight lines lead on where there are no data
SMOOTHING = 0.1  # σ²: the noise of the regression, under bumps of variance 1
FIRST_STEP, SHRINKING = 0.1, 0.93  # root mean square of a step, in halves of the actuator's range; its decay
MOMENTUM = 0.5  # share of the last direction in the next
LEAK = 0.01  # slope beyond the bounds of the action while improving: saturated actions can come back


class SmoothPolicy:
    """Actions in halves of the actuator's range, regressed on states, for each learner.

    Args:
        states: [L, M, S] where actions are chosen.
        loc: [L, 1, S] origin of the observations.
        scale: [L, 1, S] their standard deviations.
    """

    def __init__(self, states: Tensor, loc: Tensor, scale: Tensor) -> None:
        columns = states.shape[-1]
        self.states, self.loc, self.scale = states, loc, scale
        bumps = SquaredExponential(columns, WIDTH * math.sqrt(columns))
        self._kernel = (bumps + Linear(columns, SLOPE, SLOPE)).to(states).requires_grad_(False)
        points = (states - loc) / scale
        self._against = self._kernel.against(points)
        eye = torch.eye(points.shape[1], dtype=points.dtype, device=points.device)
        self._factor = cholesky(self._kernel(points, points) + SMOOTHING * eye)
        self.weights = torch.zeros_like(states[..., :1])

    def learn(self, actions: Float[Tensor, "L M A"]) -> "SmoothPolicy":
        """Make these the actions at `states`; returns itself."""
        self.weights = torch.cholesky_solve(actions, self._factor)
        return self

    def free(self, observation: Float[Tensor, "L N S"]) -> Float[Tensor, "L N A"]:
        """The regression, which may leave the bounds."""
        return self._against((observation - self.loc) / self.scale).mT @ self.weights

    def __call__(self, observation: Float[Tensor, "L N S"]) -> Float[Tensor, "L N A"]:
        """The actions, from −1 to 1."""
        return self.free(observation).clamp(-1, 1)

    def where(self, chosen: Bool[Tensor, " L"], other: "SmoothPolicy") -> "SmoothPolicy":
        """This one for the chosen learners, the other for the rest."""
        mask = chosen.view(-1, 1, 1)
        count = max(self.states.shape[1], other.states.shape[1])
        ours, theirs = (_repeated(policy.states, count) for policy in (self, other))
        loc, scale = torch.where(mask, self.loc, other.loc), torch.where(mask, self.scale, other.scale)
        policy = SmoothPolicy(torch.where(mask, ours, theirs), loc, scale)
        policy.weights = torch.where(mask, _filled(self.weights, count), _filled(other.weights, count))
        return policy

    def state_dict(self) -> dict[str, Any]:
        """All that it was made of."""
        return {"states": self.states, "loc": self.loc, "scale": self.scale, "weights": self.weights}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "SmoothPolicy":
        """What `state_dict` was taken of."""
        policy = cls(state["states"], state["loc"], state["scale"])
        policy.weights = state["weights"]
        return policy


class Outcome(NamedTuple):
    """Of imagined walks.

    Attributes:
        earned: [L, N] J of each, in units of the return.
        halfway: [L, N, S] where they are after half of the steps; the start if the task is over by then.
        lasting: [L, N] the chance that the task goes on.
    """

    earned: Tensor
    halfway: Tensor
    lasting: Tensor

    def where(self, chosen: Bool[Tensor, " L"], other: "Outcome") -> "Outcome":
        """This one for the chosen learners, the other for the rest."""
        pairs = zip(self, other, strict=True)
        return Outcome(*(torch.where(chosen.view(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


@dataclass(frozen=True)
class Walks:
    """Imagined walks of policies.

    Args:
        step: states [L, N, S] and actions [L, N, A] to what follows [L, N, S], rewards, and chances of an end
            [L, N]; differentiable.
        value: states to what is earned from there on [L, N]; differentiable.
        start: [L, N, S] where they begin.
        steps: how many.
        discount: γ per step.
    """

    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
    value: Callable[[Tensor], Tensor]
    start: Tensor
    steps: int
    discount: float

    def earned(self, action: Callable[[Tensor], Tensor]) -> Float[Tensor, " L"]:
        """J of the policy that takes these actions, in units of the return, on average over the walks."""
        return self.walk(action).earned.mean(1)

    def walk(self, action: Callable[[Tensor], Tensor]) -> Outcome:
        """Where the policy that takes these actions gets to, and what it earns."""
        states, lasting = self.start, torch.ones_like(self.start[..., 0])
        total, halfway = torch.zeros_like(lasting), states
        for done in range(self.steps):
            if done == self.steps // 2:
                halfway = torch.where((lasting > 0.5).unsqueeze(-1), states, self.start)
            states, reward, end = self.step(states, action(states))
            total = total + self.discount**done * lasting * reward
            lasting = lasting * (1 - end)
        earned = total + self.discount**self.steps * lasting * self.value(states)
        return Outcome(earned, halfway, lasting)


def rehearse(
    walks: Walks, policy: SmoothPolicy, choices: list[Float[Tensor, "L M A"]], ascents: int
) -> SmoothPolicy:
    """Begin with the best choice of actions at the policy's states, and improve it by gradient ascent.

    Args:
        walks: what to earn more in.
        policy: receives the actions.
        choices: actions to begin with, of which each learner takes those that earn most.
        ascents: gradient steps.
    """
    with torch.no_grad():
        earned = torch.stack([walks.earned(policy.learn(actions)) for actions in choices])
    best = earned.argmax(0).view(1, -1, 1, 1).expand(1, *choices[0].shape)
    actions = torch.stack(choices).gather(0, best).squeeze(0).requires_grad_(True)

    def leaking(states: Tensor) -> Tensor:
        free = policy.free(states)
        return torch.lerp(free.clamp(-1, 1), free, LEAK)

    best, most = actions.detach(), torch.full_like(earned[0], -torch.inf)
    velocity = torch.zeros_like(best)
    for done in range(ascents + 1):
        with torch.enable_grad():
            policy.learn(actions)
            earned = walks.earned(leaking)
            (uphill,) = torch.autograd.grad(earned.sum(), actions)
        with torch.no_grad():
            best = torch.where((earned > most).view(-1, 1, 1), actions, best)
            most = torch.maximum(earned, most)
            velocity = MOMENTUM * velocity + (1 - MOMENTUM) * _of_size_one(uphill)
            actions += FIRST_STEP * SHRINKING**done * _of_size_one(velocity)
    return policy.learn(best)


def _of_size_one(slope: Float[Tensor, "L M A"]) -> Float[Tensor, "L M A"]:
    """The same direction, with a root mean square of 1 for each learner."""
    size = slope.square().mean((1, 2), keepdim=True).sqrt()
    return slope / torch.where(size > 0, size, 1.0)


def _repeated(rows: Float[Tensor, "L M D"], count: int) -> Float[Tensor, "L C D"]:
    """The rows, and the last of them again to make so many."""
    return torch.cat([rows, rows[:, -1:].expand(-1, count - rows.shape[1], -1)], 1)


def _filled(rows: Float[Tensor, "L M D"], count: int) -> Float[Tensor, "L C D"]:
    """The rows, and zeros to make so many."""
    return torch.cat([rows, torch.zeros_like(rows[:, :1]).expand(-1, count - rows.shape[1], -1)], 1)


def spread(visited: Float[Tensor, "L N S"], count: int) -> Float[Tensor, "L M S"]:
    """So many states, evenly over the time in which they were visited; some again if there are fewer."""
    index = torch.linspace(0, visited.shape[1] - 1, count, device=visited.device)
    return visited[:, index.long()]
