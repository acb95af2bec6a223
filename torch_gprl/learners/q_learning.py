"""Q-learning with a Gaussian process for the action value, over continuous actions.

One update: act greedily on the critic, with some noise, for a rollout; then teach the critic (see
`q_targets`). Until the critic knows anything, actions are uniform in their box. All learners at once, each on
its own experience.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torch_gprl.critics import GPActionValue
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import Columns, Kernel, Matern, SquaredExponential
from torch_gprl.learners.collecting import Collection, batch_of, mean_return
from torch_gprl.learners.experience import Experience
from torch_gprl.learners.q_learning_config import QLearningConfig
from torch_gprl.learners.q_targets import FittedQ, OnlineQ
from torch_gprl.policies import BehaviourPolicy

KERNELS: dict[str, Callable[..., Kernel]] = {
    "matern": partial(Matern, smoothness=2.5),
    "squared-exponential": SquaredExponential,
}


class QLearning:
    """Trains action values, one for each learner of `env`, and acts greedily on them.

    Args:
        env: environment of batch [learners, environments] with a bounded action.
        config: numbers of the algorithm.
        seed: of the exploration, learner by learner: learner i of many learns what learner i alone would, if
            the environment's random numbers keep learners apart too.
        first_learner: index of the first learner in those streams.
    """

    def __init__(self, env: EnvBase, config: QLearningConfig, seed: int = 0, first_learner: int = 0) -> None:
        self.env, self.config = env, config
        self.learners, num_envs = batch_of(env)
        states = env.observation_spec["observation"].shape[-1]
        low, high = action_box_of(env)
        self.critic = make_critic(config, self.learners, states, low, high)
        self.maximiser = ActionMaximiser(self.critic, low, high, config.candidates)
        indices = range(first_learner, first_learner + self.learners)
        self.policy = BehaviourPolicy(config, self.maximiser, seed, indices)
        teacher = FittedQ if config.targets == "fitted" else OnlineQ
        self.teacher = teacher(self.critic, self.maximiser, config)
        self.collection = Collection(env, self.policy, config.rollout_steps)
        self.frames_per_update = num_envs * config.rollout_steps
        self.total_updates = -(-config.total_frames // self.frames_per_update)
        self.updates = 0
        self._last_return = torch.full((self.learners,), torch.nan, device=env.device)

    @property
    def experience(self) -> Experience | None:
        """What the critic is taught anew from, if it is."""
        return self.teacher.experience

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        return self.updates * self.frames_per_update

    def train(self) -> Iterator[dict[str, Tensor]]:
        """Run the remaining updates; yields figures of each, [learners] every one."""
        while self.updates < self.total_updates:
            self.policy.anneal(self.updates / self.total_updates)
            rollout = self.collection.rollout()
            error = self._surprise(rollout)
            self.teacher.learn(rollout)
            self.policy.uniform = not self.teacher.taught
            self.updates += 1
            yield self._figures(rollout) | {"td_error": error}

    @torch.no_grad()
    def _surprise(self, rollout: TensorDictBase) -> Tensor:
        """Root mean square of r + γ max_a Q(s', a) − Q(s, a) on experience that the critic has not seen."""
        following = rollout.get("next")
        value = self.maximiser(following.get("observation")).value
        beyond = torch.where(following.get("terminated").squeeze(-1), 0.0, value)
        target = following.get("reward").squeeze(-1) + self.config.discount * beyond
        expected = self.critic.mean_value(rollout.get("observation"), rollout.get("action"))
        return (target - expected).flatten(1).square().mean(1).sqrt()

    def _figures(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Figures of a rollout and of the critic that it made, [learners] each."""
        self._last_return = mean_return(rollout, self._last_return)
        return {
            "return": self._last_return,
            "basis_size": self.critic.gp.size.clone(),
            "value": self.critic.mean_value(rollout.get("observation"), rollout.get("action"))
            .flatten(1)
            .mean(1),
        }

    def state_dict(self) -> dict[str, Any]:
        """What was learned and where the random streams stand: tensors and plain numbers."""
        return {
            "updates": self.updates,
            "teacher": self.teacher.state_dict(),
            "collection": self.collection.state_dict(),
            "exploration": self.policy.exploration_state(),
            "last_return": self._last_return,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.updates = state["updates"]
        self.teacher.load_state_dict(state["teacher"])
        self.policy.uniform = not self.teacher.taught
        self.collection.load_state_dict(state["collection"])
        self.policy.restore_exploration(state["exploration"])
        self._last_return = state["last_return"]


def action_box_of(env: EnvBase) -> tuple[Tensor, Tensor]:
    """Lower and upper bounds of an environment's actions, [A] each, float64.

    Raises:
        ValueError: the actions are not bounded.
    """
    space = env.action_spec.space
    low, high = (getattr(space, side, None) for side in ("low", "high"))
    if low is None or high is None:
        raise ValueError(f"Q-learning compares actions within bounds, so they must be bounded, got {space}")
    return low.reshape(-1, low.shape[-1])[0].double(), high.reshape(-1, high.shape[-1])[0].double()


def make_critic(
    config: QLearningConfig, learners: int, states: int, low: Tensor, high: Tensor
) -> GPActionValue:
    """An empty critic, one Gaussian process for each learner."""
    dims, batch = states + len(low), (learners,)
    over_states = KERNELS[config.kernel](states, config.lengthscale * math.sqrt(states), batch_shape=batch)
    over_actions = SquaredExponential(len(low), config.action_lengthscale, batch_shape=batch)
    kernel = Columns(over_states, range(states), dims) * Columns(over_actions, range(states, dims), dims)
    gp = SparseOnlineGP(kernel, config.budget, config.noise, config.novelty_threshold)
    return GPActionValue(gp, action_low=low, action_high=high).to(low.device)
