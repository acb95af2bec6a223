"""How the critic of Q-learning is taught: online as the thesis has it, or by solving all experience anew.

Online (the thesis' (.8)), each rollout once, with the critic as it stands:

    y = Σ_{i<m} γ^i r_{t+i} + γ^m max_a Q(s_{t+m}, a),   the critic absorbs Q + lr (y − Q).

A target absorbed under an early critic is never forgotten. Fitted Q iteration (Ernst, Geurts and Wehenkel,
2005) repeats y = r + γ max_a Q(s', a) and the regression on y over all transitions until the values settle.
On a fixed basis the weights α are linear in y, so a sweep costs two products of matrices. Targets are clipped
to what rewards seen so far can add up to, and are at least what the same episode went on to attain (He, Liu,
Schwing and Peng, 2017), which carries a reward back along a whole episode in one sweep's time per step:

    y_t = r_t + γ max(max_a Q(s_{t+1}, a), y_{t+1})
"""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from torch import Tensor

from torch_gprl.critics import GPActionValue, k_step_returns
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.learners.experience import Experience
from torch_gprl.learners.q_learning_config import QLearningConfig
from torch_gprl.linalg import cholesky

REMEMBERED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
)
SETTLED = 1e-3  # mean change of the targets in a sweep, in their deviations, that ends a solution
RENEWAL = 1.5  # growth of experience between renewals of scaling and basis
LEAST_SPREAD = 1e-3  # of targets, as a share of the attainable range


class OnlineQ:
    """The thesis' online Q-learning.

    Args:
        critic: what is taught.
        maximiser: of the critic.
        config: discount, horizon, learning rate.
    """

    experience = None  # each rollout serves once

    def __init__(self, critic: GPActionValue, maximiser: ActionMaximiser, config: QLearningConfig) -> None:
        self.critic, self.maximiser, self.config = critic, maximiser, config

    @property
    def taught(self) -> bool:
        """Whether the critic knows anything yet."""
        return bool(self.critic.gp.observations.any())

    @torch.no_grad()
    def learn(self, rollout: TensorDictBase) -> None:
        """Absorb a rollout [learners, envs, T]; the first also fixes the scaling."""
        critic, config = self.critic, self.config
        following = rollout.get("next")
        reward, done, terminated = (
            following.get(key).squeeze(-1) for key in ("reward", "done", "terminated")
        )
        ahead = torch.where(terminated, 0.0, self.maximiser(following.get("observation")).value)
        reward = reward.to(ahead.dtype)
        target = k_step_returns(reward, ahead, done, config.discount, config.horizon)
        observation, action = rollout.get("observation"), rollout.get("action")
        if not self.taught:
            critic.standardise(observation, action, target)
        old = critic.mean_value(observation, action)
        blended = old + config.learning_rate * (target - old)  # Q + lr (y − Q)
        critic.gp.update(critic.inputs(observation, action), critic.standard_targets(blended))

    def state_dict(self) -> dict[str, Any]:
        """The critic."""
        return {"critic": self.critic.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.critic.load_state_dict(state["critic"])


class Transitions(NamedTuple):
    """All experience of each learner, in the critic's dtype."""

    observation: Float[Tensor, "learners N S"]
    action: Float[Tensor, "learners N A"]
    reward: Float[Tensor, "learners N"]
    next_observation: Float[Tensor, "learners N S"]
    terminated: Bool[Tensor, "learners N"]
    continues: Bool[Tensor, "learners N"]  # whether the next one took off where this one ended

    def range(self, discount: float) -> tuple[Float[Tensor, "learners 1"], Float[Tensor, "learners 1"]]:
        """The least and the largest discounted sum of rewards like those seen, ended by a terminal or not."""
        least, most = self.reward.min(1, keepdim=True).values, self.reward.max(1, keepdim=True).values
        return torch.minimum(least, least / (1 - discount)), torch.maximum(most, most / (1 - discount))


class Regression:
    """From targets to the weights α of the posterior mean, on a fixed basis: α = L⁻ᵀ A⁻¹ Φ W y.

    Args:
        gp: process whose basis, kernel and noise count; what it has learned does not.
        inputs: [*batch, N, D].
    """

    def __init__(self, gp: SparseOnlineGP, inputs: Float[Tensor, "*batch N D"]) -> None:
        cross = gp.kernel(gp.basis, inputs) * gp.mask.unsqueeze(-1)
        self.gram_factor = gp.gram_factor.clone()
        self.phi = torch.linalg.solve_triangular(self.gram_factor, cross, upper=False)
        novelty = gp.kernel.diag(inputs) - torch.linalg.vecdot(self.phi, self.phi, dim=-2)
        self.weight = 1 / (gp.noise_variance.unsqueeze(-1) + novelty)
        precision = (self.phi * self.weight.unsqueeze(-2)) @ self.phi.mT
        precision.diagonal(dim1=-2, dim2=-1).add_(1)
        self.factor = cholesky(precision)

    def alpha(self, targets: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch B"]:
        """The weights for these targets."""
        information = self.phi @ (self.weight * targets).unsqueeze(-1)
        whitened = torch.cholesky_solve(information, self.factor)
        return torch.linalg.solve_triangular(self.gram_factor.mT, whitened, upper=True).squeeze(-1)


class FittedQ:
    """Fitted Q iteration on everything that was ever seen.

    Args:
        critic: what is taught.
        maximiser: of the critic.
        config: discount, sweeps, growth, optimism, length scales.
    """

    def __init__(self, critic: GPActionValue, maximiser: ActionMaximiser, config: QLearningConfig) -> None:
        self.critic, self.maximiser, self.config = critic, maximiser, config
        self.experience = Experience(config.total_frames)
        self.solved = self.renewed = 0  # transitions of each learner at the last solution, and renewal

    @property
    def taught(self) -> bool:
        """Whether the critic knows anything yet."""
        return self.solved > 0

    @torch.no_grad()
    def learn(self, rollout: TensorDictBase) -> None:
        """Remember a rollout [learners, envs, T], and solve if experience has grown enough."""
        self.experience.extend(rollout.select(*REMEMBERED).reshape(rollout.shape[0], -1))
        if len(self.experience) > self.solved * (1 + self.config.growth):
            self.solve()

    @torch.no_grad()
    def solve(self) -> None:
        """Bring the critic's values to the fixed point of y = r + γ max_a Q(s', a)."""
        data, gp = self._remembered(), self.critic.gp
        target = self._first_targets(data)
        if len(self.experience) > self.renewed * RENEWAL:
            self._renew(data)
        self._scale(data, target)
        inputs = self.critic.inputs(data.observation, data.action)
        gp.forget()
        gp.update(inputs, self._standard(target), stamp=self.solved)  # chooses the basis
        target = self._iterate(data, target, inputs)
        threshold, gp.novelty_threshold = gp.novelty_threshold, math.inf  # the basis is what it is
        gp.forget()
        gp.update(inputs, self._standard(target))
        gp.novelty_threshold = threshold
        self.solved = len(self.experience)

    def _remembered(self) -> Transitions:
        stored, like = self.experience.all(), self.critic.input_loc
        following, observation = stored.get("next"), stored.get("observation")
        done = following.get("done").squeeze(-1)
        joined = (following.get("observation")[:, :-1] == observation[:, 1:]).all(-1) & ~done[:, :-1]
        return Transitions(
            observation.to(like),
            stored.get("action").to(like),
            following.get("reward").squeeze(-1).to(like),
            following.get("observation").to(like),
            following.get("terminated").squeeze(-1).to(like.device),
            torch.cat([joined, torch.zeros_like(done[:, :1])], 1).to(like.device),
        )

    def _first_targets(self, data: Transitions) -> Tensor:
        """What to start from: today's values, or a constant reward for ever."""
        if self.taught:
            value = self.maximiser(data.next_observation).value
        else:
            value = (data.reward.mean(1, keepdim=True) / (1 - self.config.discount)).expand_as(data.reward)
        return self._target(data, value)

    def _target(self, data: Transitions, value: Tensor) -> Float[Tensor, "learners N"]:
        """The target r + γ V(s'), with V within the attainable range and 0 where s' is terminal."""
        low, high = data.range(self.config.discount)
        beyond = torch.where(data.terminated, 0.0, torch.clamp(value, low, high))
        return data.reward + self.config.discount * beyond

    def _renew(self, data: Transitions) -> None:
        """Forget the basis, and scale inputs by all that was seen: actions by their range."""
        critic, box = self.critic, self.maximiser
        critic.gp.reset()
        actions = data.action.shape[-1]
        std = data.observation.std(1, correction=0)
        critic.input_loc[:, :-actions] = data.observation.mean(1)
        critic.input_scale[:, :-actions] = torch.where(std > 1e-6, std, 1.0)
        critic.input_loc[:, -actions:] = (box.high + box.low) / 2
        critic.input_scale[:, -actions:] = (box.high - box.low) / 2
        self.renewed = len(self.experience)

    def _scale(self, data: Transitions, target: Tensor) -> None:
        """The prior: where nothing is known the value is `optimism` deviations above the mean."""
        low, high = data.range(self.config.discount)
        floor = (LEAST_SPREAD * (high - low)).squeeze(1).clamp_min(1e-6)
        std = torch.maximum(target.std(1, correction=0), floor)
        self.critic.target_scale.copy_(std)
        self.critic.target_loc.copy_(target.mean(1) + self.config.optimism * std)

    def _standard(self, target: Tensor) -> Tensor:
        return self.critic.standard_targets(target.unsqueeze(-1))

    def _iterate(self, data: Transitions, target: Tensor, inputs: Tensor) -> Float[Tensor, "learners N"]:
        """Sweeps until the targets settle, learner by learner."""
        loc, scale = self.critic.target_loc.unsqueeze(-1), self.critic.target_scale.unsqueeze(-1)
        regression = Regression(self.critic.gp, inputs)
        products = self.maximiser.products(data.next_observation)
        moving = torch.ones_like(loc, dtype=torch.bool)
        for _ in range(self.config.sweeps):
            best = products.mean(regression.alpha((target - loc) / scale)).amax(-1)
            value = loc + scale * best
            if self.config.hindsight:
                attained = torch.where(data.continues, target.roll(-1, 1), -torch.inf)
                value = torch.maximum(value, attained)
            renewed = self._target(data, value)
            change = (renewed - target).abs().mean(-1, keepdim=True) / scale
            target = torch.where(moving, renewed, target)
            moving = moving & (change > SETTLED)
            if not bool(moving.any()):
                break
        return target

    def state_dict(self) -> dict[str, Any]:
        """Critic and experience."""
        return {
            "critic": self.critic.state_dict(),
            "experience": self.experience.state_dict(),
            "solved": self.solved,
            "renewed": self.renewed,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.critic.load_state_dict(state["critic"])
        self.experience.load_state_dict(state["experience"])
        self.solved, self.renewed = state["solved"], state["renewed"]
