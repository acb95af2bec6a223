"""Learners on environments that teach nothing, or in odd ways: they go on, in finite numbers."""

from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_gprl.learners import (
    ActorCritic,
    ActorCriticConfig,
    DynamicProgramming,
    DynamicProgrammingConfig,
    PolicyGradient,
    PolicyGradientConfig,
    QLearning,
    QLearningConfig,
)

BATCH = (2, 3)
STEPS = 20


class Oddity(NamedTuple):
    """What is odd about an environment."""

    dims: int = 2  # of the observation
    reward: float | None = None  # the same always; the first entry of the observation unless given
    still: bool = False  # every state is the same
    ends: bool = False  # every episode ends with its first step
    rollout_steps: int = STEPS


class Odd(EnvBase):
    """States drawn at random, whatever the action."""

    def __init__(self, oddity: Oddity) -> None:
        super().__init__(batch_size=BATCH)
        self.oddity, self.generator = oddity, torch.Generator().manual_seed(0)
        shape = (*BATCH, 1)
        self.observation_spec = Composite(observation=Unbounded((*BATCH, oddity.dims)), shape=BATCH)
        self.action_spec = Bounded(-2.0, 2.0, shape)
        self.reward_spec = Unbounded(shape)
        flags = {name: Binary(1, shape, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=BATCH)

    def _state(self) -> Tensor:
        shape = (*BATCH, self.oddity.dims)
        return torch.zeros(shape) if self.oddity.still else torch.randn(shape, generator=self.generator)

    def _flags(self, terminated: bool) -> dict[str, Tensor]:
        ends = torch.full((*BATCH, 1), terminated)
        return {"done": ends, "terminated": ends.clone(), "truncated": torch.zeros_like(ends)}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        return TensorDict({"observation": self._state(), **self._flags(False)}, BATCH)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        state, given = self._state(), self.oddity.reward
        reward = state[..., :1] if given is None else torch.full((*BATCH, 1), given)
        return TensorDict({"observation": state, "reward": reward, **self._flags(self.oddity.ends)}, BATCH)

    def _set_seed(self, seed: int | None) -> None:
        pass


ODDITIES = {
    "one column": Oddity(dims=1),
    "100 columns": Oddity(dims=100),
    "rewards all alike": Oddity(reward=1.0),
    "no reward": Oddity(reward=0.0),
    "huge rewards": Oddity(reward=1e8),
    "states all alike": Oddity(still=True),
    "nothing ever happens": Oddity(still=True, reward=0.0),
    "episodes of one step": Oddity(ends=True),
    "rollouts of one step": Oddity(rollout_steps=1),
    "one step of each": Oddity(ends=True, rollout_steps=1),
}


def policy_gradient(env: EnvBase, steps: int, **options: Any) -> PolicyGradient:
    config = PolicyGradientConfig(total_frames=3 * 3 * steps, rollout_steps=steps, budget=15, **options)
    return PolicyGradient(env, config)


def q_learning(env: EnvBase, steps: int, **options: Any) -> QLearning:
    frames = 3 * max(steps, 5) * 3
    config = QLearningConfig(total_frames=frames, rollout_steps=steps, budget=15, sweeps=3, **options)
    return QLearning(env, config)


def actor_critic(env: EnvBase, steps: int, **options: Any) -> ActorCritic:
    sizes = {"budget": 15, "sweeps": 2, "fit_steps": 2, "first_frames": 3 * steps}
    config = ActorCriticConfig(total_frames=3 * 3 * steps, rollout_steps=steps, **sizes, **options)
    return ActorCritic(env, config)


def dynamic_programming(env: EnvBase, steps: int) -> DynamicProgramming:
    sizes = {"model_budget": 15, "support": 10, "imagined": 10, "sweeps": 3, "first_steps": max(3 * steps, 2)}
    config = DynamicProgrammingConfig(total_frames=3 * 3 * steps, rollout_steps=steps, **sizes)
    return DynamicProgramming(env, config)


LEARNERS = {
    "policy gradient": policy_gradient,
    "policy gradient, differences": lambda *given: policy_gradient(*given, targets="differences"),
    "q-learning": q_learning,
    "q-learning, online": lambda *given: q_learning(*given, targets="online"),
    "actor-critic": actor_critic,
    "dynamic programming": dynamic_programming,
}


QUICK = ("nothing ever happens", "one step of each")  # the oddest of all; the others are slow in sum


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize(
    "oddity", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ODDITIES]
)
def test_a_learner_goes_on(oddity: str, learner: str):
    odd = ODDITIES[oddity]
    made = LEARNERS[learner](Odd(odd), odd.rollout_steps)
    updates = list(made.train())
    assert len(updates) == made.total_updates
    assert made.frames >= made.config.total_frames
    numbers = [*made.policy.parameters(), *made.critic.state_dict().values()]
    assert all(number.isfinite().all() for number in numbers if isinstance(number, Tensor))
    state = Odd(odd).reset()
    action = made.policy(state)["action"]
    assert action.isfinite().all()
    value = made.critic.value(state["observation"], action)
    assert value.mean.isfinite().all()
    assert (value.variance >= -1e-8 * value.mean.square().max().clamp_min(1)).all()
