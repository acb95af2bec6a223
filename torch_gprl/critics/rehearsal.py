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
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.kernels import SquaredExponential
from torch_gprl.linalg import cholesky

WIDTH = 0.5  # of the policy's bumps, in standard deviations of the observations times √columns
SMOOTHING = 0.1  # σ²: the noise of the regression, under a kernel of variance 1
STEP_SIZE = 0.05  # of Adam, in halves of the actuator's range
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
        self._kernel = SquaredExponential(columns, WIDTH * math.sqrt(columns)).to(states)
        self._kernel.requires_grad_(False)
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

    def state_dict(self) -> dict[str, Any]:
        """All that it was made of."""
        return {"states": self.states, "loc": self.loc, "scale": self.scale, "weights": self.weights}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "SmoothPolicy":
        """What `state_dict` was taken of."""
        policy = cls(state["states"], state["loc"], state["scale"])
        policy.weights = state["weights"]
        return policy


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
        states, lasting = self.start, torch.ones_like(self.start[..., 0])
        total = torch.zeros_like(lasting)
        for _ in range(self.steps):
            states, reward, end = self.step(states, action(states))
            total = total + lasting * reward
            lasting = self.discount * lasting * (1 - end)
        return (total + lasting * self.value(states)).mean(1)


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

    optimiser = torch.optim.Adam([actions], lr=STEP_SIZE, betas=(0.9, 0.99), maximize=True)
    for _ in range(ascents):
        with torch.enable_grad():
            policy.learn(actions)
            (actions.grad,) = torch.autograd.grad(walks.earned(leaking).sum(), actions)
        optimiser.step()
    return policy.learn(actions.detach())


def spread(visited: Float[Tensor, "L N S"], count: int) -> Float[Tensor, "L M S"]:
    """So many states, or all if there are fewer, evenly over the time in which they were visited."""
    steps = visited.shape[1]
    index = torch.linspace(0, steps - 1, min(count, steps), device=visited.device)
    return visited[:, index.long()]
