"""The comparison of gradient estimators: its figures against known ones, its arms against each other."""

from typing import get_args

import pytest
import torch

from benchmarks.gradient_arms import ARMS, evaluations, fit_critics, gradients, quality
from benchmarks.gradient_data import EPISODES, SETTINGS, STEPS, Batches, Fixed, batches
from torch_gprl.critics import EstimatorName
from torch_gprl.learners import PolicyGradientConfig
from torch_gprl.policies import RBFController

LEARNERS = 3
NUMBERS = PolicyGradientConfig(budget=30, discount=SETTINGS[0].discount)


def test_figures_are_those_of_the_distribution():
    mean, spread = torch.tensor([3.0, 4.0]).double(), torch.tensor([1.0, 2.0]).double()
    drawn = mean + spread * torch.randn(20_000, 2, dtype=torch.float64)
    reference = torch.tensor([5.0, 0.0]).double()
    found = quality(drawn, reference)
    expected = {"nsr": 5 / 25, "cos_mean": 3 / 5, "relative_mse": (5 + 4 + 16) / 25}
    for name, value in expected.items():
        centre, low, high = getattr(found, name).tolist()
        assert centre == pytest.approx(value, rel=0.03)
        assert low < centre < high


def test_a_constant_estimate_has_no_noise():
    estimate = torch.tensor([[1.0, 1.0]]).double().expand(10, 2)
    found = quality(estimate, torch.tensor([2.0, 0.0]).double())
    assert found.nsr.abs().max() < 1e-12
    torch.testing.assert_close(found.cos_batch, torch.full((3,), 0.5**0.5).double())


@pytest.fixture(scope="module")
def made() -> tuple[Batches, Batches]:
    """Two batches of an untrained pendulum controller for each learner."""
    torch.manual_seed(0)
    fixed = Fixed(SETTINGS[0], "mid", RBFController(3, 1, seed=3).state_dict(), 0.0)
    return batches(fixed, LEARNERS, 0), batches(fixed, LEARNERS, 1)


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
    critics = fit_critics(earlier, NUMBERS)
    seen = evaluations(new, critics, NUMBERS.discount)
    for arm in ARMS:
        found = gradients(arm, new, critics, seen)
        assert found.shape[0] == LEARNERS
        assert (found.norm(dim=1) > 0).all()


def test_arms_cover_every_estimator_and_are_told_apart():
    assert {arm.estimator for arm in ARMS} == set(get_args(EstimatorName))
    assert len({arm.label for arm in ARMS}) == len(ARMS)
