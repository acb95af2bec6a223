"""The temporal differences of all experience, solved for the value of any deterministic policy.

    r = Q(s, a) − γ Q(s', f(s')) + noise,   without the second term where s' is terminal

Engel, Mannor and Meir (2005), off-policy: the actions are those that were taken, the next ones are f's, so
nothing becomes out of date when f changes; only the term of s' is evaluated anew. From the same kernel values
come the slopes of Q in the next actions, by which f is improved: Silver et al. (2014), "Deterministic policy
gradient algorithms".
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from torch import Tensor

from torch_gprl.critics.action_value import GPActionValue
from torch_gprl.gp.prescribed import observe_anew
from torch_gprl.kernels.slopes import mean_slopes, radial
from torch_gprl.kernels.stationary import Stationary


class Transitions(NamedTuple):
    """All experience of each learner, in the critic's dtype."""

    observation: Float[Tensor, "learners N S"]
    action: Float[Tensor, "learners N A"]
    reward: Float[Tensor, "learners N"]
    next_observation: Float[Tensor, "learners N S"]
    terminated: Bool[Tensor, "learners N"]

    @classmethod
    def of(cls, stored: TensorDictBase, like: Tensor) -> "Transitions":
        """Those of a tensordict [learners, N], with dtype and device of `like`."""
        following = stored.get("next")
        return cls(
            stored.get("observation").to(like),
            stored.get("action").to(like),
            following.get("reward").squeeze(-1).to(like),
            following.get("observation").to(like),
            following.get("terminated").squeeze(-1).to(like.device),
        )

    def reward_moments(self) -> tuple[Float[Tensor, " learners"], Float[Tensor, " learners"]]:
        """Mean and variance of the reward, where a terminal state counts as one more step without reward."""
        ends = self.terminated.sum(1)
        count = self.reward.shape[1] + ends
        mean = self.reward.sum(1) / count
        square = (self.reward - mean.unsqueeze(1)).square().sum(1) + ends * mean.square()
        return mean, square / count


class Slopes(NamedTuple):
    """Gradient and second derivatives of Q in the action, in standardised units."""

    gradient: Float[Tensor, "learners N A"]
    curvature: Float[Tensor, "learners N A"]


class DifferenceEquations:
    """Transitions as equations for the critic's values on its basis.

    Args:
        critic: whose basis, scaling, kernel and noise count; its values are what `solve` sets.
        transitions: the experience.
        discount: γ per step.
    """

    def __init__(self, critic: GPActionValue, transitions: Transitions, discount: float) -> None:
        self.critic, self.transitions = critic, transitions
        gp = critic.gp
        assert isinstance(gp.kernel, Stationary)
        self.kernel = gp.kernel
        rows = int(gp.size.max())
        self.basis, self.mask = gp.basis[..., :rows, :], gp.mask[..., None, :rows]
        self.cross = self.kernel(critic.inputs(transitions.observation, transitions.action), self.basis)
        self.rate = discount * (~transitions.terminated).to(transitions.reward.dtype)
        self.targets = critic.standard_targets(transitions.reward.unsqueeze(-1), self.rate)

    @torch.no_grad()
    def solve(self, next_action: Float[Tensor, "learners N A"]) -> Slopes:
        """Make the critic that of a policy whose actions in the next states are these; its slopes there."""
        gp = self.critic.gp
        inputs = self.critic.inputs(self.transitions.next_observation, next_action)
        following = radial(self.kernel, inputs, self.basis)
        design = (self.cross - self.rate.unsqueeze(-1) * following.value) * self.mask
        observe_anew(gp, design, self.targets)
        columns = slice(-next_action.shape[-1], None)
        lengthscale = self.kernel.lengthscale[..., columns]
        weights = gp.alpha[..., : self.basis.shape[-2]]
        return Slopes(
            *mean_slopes(following, weights, inputs[..., columns], self.basis[..., columns], lengthscale)
        )
