"""The comparison of gradient estimators: its figures against known ones, its arms against each other."""

from typing import get_args

import pytest
import torch

import envs
from benchmarks.gradient_arms import (
    ARMS,
    GAUSSIAN,
    REPLAYED,
    at_once,
    evaluations,
    first,
    fit_critics,
    fit_pooled,
    gradients,
    quality,
)
from benchmarks.gradient_data import EPISODES, SETTINGS, STEPS, Batches, Fixed, batches
from benchmarks.gradient_quality import SIDE_BY_SIDE, Options, Records, compare
from benchmarks.gradient_truth import ACTIONS, STATES, Branches, branches
from torch_gprl.critics import EstimatorName, GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.learners import PolicyGradientConfig
from torch_gprl.policies import RBFController

LEARNERS = 3
NUMBERS = PolicyGradientConfig(budget=30, discount=SETTINGS[0].discount)


def test_figures_are_those_of_the_distribution():
    mean, spread = torch.tensor([3.0, 4.0]).double(), torch.tensor([1.0, 2.0]).double()
    drawn = mean + spread * torch.randn(4_000, 2, dtype=torch.float64)
    reference = torch.tensor([5.0, 0.0]).double()
    found = quality(drawn, reference)
    expected = {"nsr": 5 / 25, "cos_mean": 3 / 5, "relative_mse": (5 + 4 + 16) / 25}
    for name, value in expected.items():
        centre, low, high = getattr(found, name).tolist()
        assert centre == pytest.approx(value, rel=0.06)
        assert low < centre < high


def test_a_constant_estimate_has_no_noise():
    estimate = torch.tensor([[1.0, 1.0]]).double().expand(10, 2)
    found = quality(estimate, torch.tensor([2.0, 0.0]).double())
    assert found.nsr.abs().max() < 1e-12
    torch.testing.assert_close(found.cos_batch, torch.full((3,), 0.5**0.5).double())


def untrained() -> Fixed:
    return Fixed(SETTINGS[0], "mid", RBFController(3, 1, seed=3).state_dict(), 0.0)


def pendulums(learners: int) -> envs.BatchEnv:
    return envs.make(SETTINGS[0].task, learners=learners, num_envs=1, threads=1)


@pytest.fixture(scope="module")
def made() -> tuple[Batches, Batches]:
    """Two batches of an untrained pendulum controller for each learner."""
    torch.manual_seed(0)
    return batches(untrained(), LEARNERS, 0), batches(untrained(), LEARNERS, 1)


def test_the_true_return_counts_rewards_behind_the_cut(made):
    data, returns = made[0].data, made[0].true_return
    assert data.shape == returns.shape == (LEARNERS, EPISODES, STEPS)
    assert data["next", "truncated"][..., -1, :].all()
    assert not data["next", "done"][..., :-1, :].any()
    reward = data["next", "reward"].squeeze(-1).double()
    ahead = (returns - reward)[..., :-1] / NUMBERS.discount
    torch.testing.assert_close(ahead, returns[..., 1:], rtol=1e-9, atol=1e-9)
    assert (returns[..., -1] < reward[..., -1] - 1).any()


def test_every_arm_gives_a_gradient_for_every_batch(made):
    earlier, new = made
    one = Batches(earlier.data[:1], earlier.true_return[:1], untrained().policy(1, 0, pendulums(1)))
    pooled = fit_pooled(one, NUMBERS, LEARNERS)
    critics = fit_critics(earlier, earlier, pooled, NUMBERS)
    seen = evaluations(new, critics, NUMBERS.discount)
    for arm in ARMS:
        found = gradients(arm, new, earlier, critics, seen)
        assert found.shape[0] == LEARNERS
        assert (found.norm(dim=1) > 0).all()
    alone = fit_critics(earlier, None, pooled, NUMBERS)
    assert alone.gaussian.keys() == critics.gaussian.keys() - REPLAYED.keys()


def test_each_arm_is_judged_by_the_batches_that_it_saw(tmp_path, monkeypatch):
    def recall(records: Records, name: str, make: object) -> dict[str, torch.Tensor]:
        if name.startswith("reference"):
            return {"gradient": torch.ones(SIDE_BY_SIDE, 2).double()}
        dear = REPLAYED if name.startswith("one-earlier") else ()
        labels = [arm.label for arm in ARMS if arm.critic not in dear] + [*set(GAUSSIAN) - {*dear}]
        return {label: torch.randn(SIDE_BY_SIDE, 2).double() for label in labels}

    monkeypatch.setattr(Records, "recall", recall)
    one = SIDE_BY_SIDE
    found = compare(untrained(), Options(batches=3 * one, several=one, reference_batches=one, out=tmp_path))
    for arm in ARMS:
        assert found.batches[arm.label] == one * (1 if arm.critic in REPLAYED else 3)
        assert found.estimators[arm.label].nsr[0] > 0


def test_a_critic_that_replays_solves_every_step_on_a_basis_that_grows_with_them(made):
    batch = made[0]
    data, returns = torch.cat([batch.data] * 3, 1), torch.cat([batch.true_return] * 3, 1)
    several = Batches(data, returns, batch.policy)
    for count in (1, 2):
        kept = first(several, count)
        torch.testing.assert_close(kept.data["action"], torch.cat([batch.data["action"]] * count, 1))
        numbers = at_once(kept, NUMBERS)
        assert numbers.solved == numbers.replay == 5 * numbers.budget == count * EPISODES * STEPS


def test_arms_cover_every_estimator_and_are_told_apart():
    assert {arm.estimator for arm in ARMS} == set(get_args(EstimatorName))
    assert len({arm.label for arm in ARMS}) == len(ARMS)


class Known(GPActionValue):
    """A critic whose advantages are those of the branches, times two, and whose values are another's."""

    def __init__(self, truth: Branches) -> None:
        super().__init__(SparseOnlineGP(SquaredExponential(4, batch_shape=(2,)), 10))
        self.truth = truth

    def mean_value(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        value = 100 * observation[..., :1].sum(-1)
        return value + 2 * self.truth.mean_return


def test_advantages_are_compared_within_states():
    truth = branches(untrained(), 0)
    torch.testing.assert_close(truth.correlation(Known(truth)), torch.ones(2).double())


def test_branches_return_what_the_policy_returns(made):
    truth, returns = branches(untrained(), 0), made[0].true_return
    by_state = truth.mean_return.mean(1)
    # 32 states, and the 15 episodes of the batches, whose steps hang together
    error = (by_state.var() / STATES + returns.mean(-1).var() / (LEARNERS * EPISODES)).sqrt()
    assert (by_state.mean() - returns.mean()).abs() < 4 * error
    assert truth.action.shape == (STATES, ACTIONS, 1)
