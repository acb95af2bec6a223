"""Foresight: what a critic predicted, against returns that are known, and the coverage of its intervals."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_gprl.gp import Posterior
from torch_gprl.runs import foresee, foresight_figure
from torch_gprl.runs.foresight import LEVELS, Foresight

DISCOUNT = 0.5


class Countdown(EnvBase):
    """Two learners, two environments: the reward is the step's number; the second environment terminates."""

    def __init__(self) -> None:
        super().__init__(batch_size=(2, 2))
        self.observation_spec = Composite(observation=Unbounded((2, 2, 1)), shape=(2, 2))
        self.action_spec = Bounded(-1, 1, (2, 2, 1))
        self.reward_spec = Unbounded((2, 2, 1))

    def _reset(self, tensordict=None, **kwargs) -> TensorDict:
        self.count = 0
        return TensorDict({"observation": torch.zeros(2, 2, 1)}, (2, 2))

    def _step(self, tensordict) -> TensorDict:
        self.count += 1
        number = torch.full((2, 2, 1), float(self.count))
        over = torch.full((2, 2, 1), self.count >= 3)
        terminated = over & torch.tensor([False, True])[None, :, None]
        out = {"observation": number, "reward": number, "terminated": terminated, "done": over}
        return TensorDict(out | {"truncated": over & ~terminated}, (2, 2))

    def _set_seed(self, seed) -> None:
        pass


def test_returns_are_discounted_and_bootstrapped_where_time_ran_out():
    policy = TensorDictModule(lambda seen: seen, in_keys=["observation"], out_keys=["action"])
    scale = torch.tensor([1.0, 10.0])[:, None]
    critic = SimpleNamespace(
        value=lambda seen, act: Posterior(scale * (seen + act)[..., 0], torch.full(seen.shape[:2], 4.0))
    )
    seen = foresee(Countdown(), policy, critic, DISCOUNT, learner=1)
    assert seen.mean.tolist() == [0.0, 20.0, 40.0] * 2  # 10 (s + a) with a = s
    assert seen.stddev.tolist() == [2.0] * 6
    bootstrap = 60.0  # the value of the state 3, which the first environment ends in by time
    cut = [1 + 0.5 * 2 + 0.25 * 3 + 0.125 * bootstrap, 2 + 0.5 * 3 + 0.25 * bootstrap, 3 + 0.5 * bootstrap]
    over = [1 + 0.5 * 2 + 0.25 * 3, 2 + 0.5 * 3, 3]
    assert seen.realised == pytest.approx(cut + over)


def test_coverage_is_the_level_where_errors_are_normal():
    numbers = np.random.default_rng(0).normal(size=(2, 20_000))
    exact = Foresight(numbers[0], np.full(20_000, 0.5), numbers[0] + 0.5 * numbers[1])
    assert exact.coverage() == pytest.approx(LEVELS, abs=0.014)  # four standard errors
    vain = Foresight(numbers[0], np.full(20_000, 0.1), numbers[0] + 0.5 * numbers[1])
    assert (vain.coverage()[:-1] < LEVELS[:-1] - 0.05).all()


def test_the_figure_shows_predictions_returns_and_coverage():
    seen = Foresight(np.array([1.0, 2.0]), np.array([0.1, 0.2]), np.array([1.5, 2.0]))
    left, right = foresight_figure(seen).axes
    assert left.get_lines()[0].get_xdata().tolist() == [1.0, 2.0]
    assert left.get_lines()[0].get_ydata().tolist() == [1.5, 2.0]
    assert right.get_lines()[1].get_ydata() == pytest.approx(seen.coverage())
