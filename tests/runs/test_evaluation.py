"""Evaluation: the first episode of every environment counts, once, without exploration."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from torch_gprl.runs import evaluate, film, summary


class Countdown(EnvBase):
    """Copy (l, e) runs e + 1 steps, its reward is the action; `_step` counts on after that."""

    def __init__(self, learners: int, num_envs: int) -> None:
        super().__init__(batch_size=torch.Size([learners, num_envs]))
        one = (learners, num_envs, 1)
        self.observation_spec = Composite(observation=Unbounded(one), shape=self.batch_size)
        self.action_spec = Unbounded(one)
        self.reward_spec = Unbounded(one)
        self.done_spec = Composite(done=Binary(1, one, dtype=torch.bool), shape=self.batch_size)
        self.length = torch.arange(1.0, num_envs + 1).expand(learners, num_envs).unsqueeze(-1)
        self.passed = torch.zeros(one)

    def _reset(self, tensordict: TensorDict | None) -> TensorDict:
        again = tensordict.get("_reset", None) if tensordict is not None else None
        self.passed = torch.zeros_like(self.passed) if again is None else self.passed.where(~again, 0)
        return TensorDict({"observation": self.passed.clone()}, self.batch_size)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.passed = self.passed + 1
        step = {
            "observation": self.passed.clone(),
            "reward": tensordict["action"],
            "done": self.passed >= self.length,
        }
        return TensorDict(step, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        pass

    def render(self, learner: int, env: int, width: int, height: int) -> torch.Tensor:
        return self.passed[learner, env].to(torch.uint8).expand(height, width, 3)


def policy(observation: torch.Tensor) -> torch.Tensor:
    """One per step for the first learner, two for the second; nothing with exploration."""
    deterministic = exploration_type() == ExplorationType.DETERMINISTIC
    rate = torch.arange(1.0, 1 + len(observation))[:, None, None]
    return rate.expand_as(observation) * deterministic


POLICY = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])


def test_each_environment_counts_its_first_episode():
    returns = evaluate(Countdown(learners=2, num_envs=3), POLICY)
    assert returns.tolist() == [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]


def test_gradients_are_neither_kept_nor_switched_off_afterwards():
    weight = torch.ones((), requires_grad=True)
    scaled = TensorDictModule(lambda o: weight * o, in_keys=["observation"], out_keys=["action"])
    assert not evaluate(Countdown(1, 2), scaled).requires_grad
    assert torch.is_grad_enabled()


@pytest.mark.parametrize(("most_frames", "expected"), [(10, [0, 1, 2]), (2, [0, 1])])
def test_a_film_ends_with_the_episode_or_at_its_limit(most_frames, expected):
    env = Countdown(learners=2, num_envs=1)
    env.length = torch.full((2, 1, 1), 3.0)
    frames = film(env, POLICY, learner=1, most_frames=most_frames)
    assert frames[:, 0, 0, 0].tolist() == expected


def test_the_summary_is_over_learners():
    assert summary(torch.tensor([[1.0, 3.0], [4.0, 4.0], [6.0, 6.0]])).startswith("final return 4.00, ")
    assert "worst 2.00, best 6.00, over 3 learners, 2 episodes each" in summary(
        torch.tensor([[1.0, 3.0], [4.0, 4.0], [6.0, 6.0]])
    )


def test_the_summary_of_one_learner_is_over_its_episodes():
    assert "worst 1.00, best 3.00, over 2 episodes" in summary(torch.tensor([[1.0, 3.0]]))
