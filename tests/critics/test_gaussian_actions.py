"""Averages over a Gaussian policy: clipped moments against sampling and limits, V(s) against Monte Carlo."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torch_gprl.critics import GPActionValue, action_moments, clipped_moments
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.policies import LinearController, gaussian_policy

LOW, HIGH = torch.tensor([-2.0], dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64)
MEANS = torch.linspace(-6, 6, 25, dtype=torch.float64).unsqueeze(-1)


def by_quadrature(mean: torch.Tensor, std: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    z = torch.linspace(-9, 9, 200_001, dtype=torch.float64)
    weight = torch.exp(-0.5 * z.square())
    weight = weight / weight.sum()
    clipped = (mean + std * z).clamp(LOW, HIGH)
    first = (clipped * weight).sum(-1, keepdim=True)
    return first, ((clipped - first).square() * weight).sum(-1, keepdim=True)


@pytest.mark.parametrize("std", [0.05, 0.7, 10.0])
def test_clipped_moments_are_those_of_the_clipped_gaussian(std):
    scale = torch.full_like(MEANS, std)
    for mine, theirs in zip(
        clipped_moments(MEANS, scale, LOW, HIGH), by_quadrature(MEANS, scale), strict=True
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-9)


def test_bounds_far_away_leave_the_moments_alone():
    scale = torch.full_like(MEANS, 0.3)
    mean, variance = clipped_moments(MEANS, scale, LOW - 1e6, HIGH + 1e6)
    torch.testing.assert_close(mean, MEANS, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(variance, scale.square(), rtol=1e-9, atol=1e-12)


def test_where_every_action_is_clipped_nothing_varies_and_nothing_pulls():
    loc = torch.tensor([[-500.0], [500.0]], dtype=torch.float64, requires_grad=True)
    mean, variance = clipped_moments(loc, torch.ones_like(loc), LOW, HIGH)
    assert torch.equal(mean.detach(), torch.stack([LOW, HIGH]))
    assert torch.equal(variance.detach(), torch.zeros_like(variance))
    (slope,) = torch.autograd.grad((mean + variance).sum(), loc)
    assert torch.equal(slope, torch.zeros_like(slope))


def test_clipped_moments_are_differentiable():
    inside = torch.linspace(-2.5, 1.5, 9, dtype=torch.float64).unsqueeze(-1).requires_grad_()
    std = torch.full_like(inside, 0.8).requires_grad_()
    assert torch.autograd.gradcheck(lambda m, s: clipped_moments(m, s, LOW, HIGH), (inside, std))


# ---------------------------------------------------------------- the value of a state


def taught(*batch: int, bounded: bool) -> GPActionValue:
    gp = SparseOnlineGP(SquaredExponential(3, batch_shape=batch), 80, 0.01)
    bounds = {"action_low": -torch.ones(1), "action_high": torch.ones(1)} if bounded else {}
    critic = GPActionValue(gp, **bounds).requires_grad_(False)
    observation, action = torch.randn(*batch, 200, 2), torch.randn(*batch, 200, 1)
    applied = action.clamp(-1, 1) if bounded else action
    target = 5 + observation[..., :1] * applied - applied.square()
    critic.standardise(observation, action, target)
    critic.update(
        TensorDict({"observation": observation, "action": action, "value_target": target}, (*batch, 200))
    )
    return critic


# two moments of the clipped action are all that a long length scale sees, and not quite all of a short one
@pytest.mark.parametrize(("bounded", "tolerance"), [(False, 0.0), (True, 0.06)])
def test_the_value_of_a_state_is_the_average_over_actions(bounded, tolerance):
    critic = taught(bounded=bounded)
    observation = torch.randn(6, 2, dtype=torch.float64)
    loc, scale = (
        torch.linspace(-1.5, 1.5, 6, dtype=torch.float64).unsqueeze(-1),
        torch.full((6, 1), 0.4).double(),
    )
    value = critic.mean_state_value(observation, loc, scale)
    actions = loc + scale * torch.randn(20_000, 6, 1, dtype=torch.float64)
    sampled = critic.mean_value(observation.expand(20_000, 6, 2), actions)
    error = 5 * sampled.std(0) / 20_000**0.5  # fails once in a million draws
    assert ((value - sampled.mean(0)).abs() < error + tolerance * sampled.std(0)).all()
    posterior = critic.state_value(observation, loc, scale)
    torch.testing.assert_close(posterior.mean, value, rtol=1e-9, atol=1e-9)
    assert (posterior.variance > 0).all()


def test_without_spread_it_is_the_value_of_the_mean_action():
    critic = taught(2, bounded=True)
    observation, loc = torch.randn(2, 4, 7, 2), 2 * torch.randn(2, 4, 7, 1)
    value = critic.state_value(observation, loc, torch.zeros_like(loc) + 1e-12)
    for mine, theirs in zip(value, critic.value(observation, loc), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6)


def test_its_gradient_in_the_policy_is_that_of_the_average():
    critic = taught(bounded=True)
    observation = torch.randn(4, 2, dtype=torch.float64)
    loc = torch.tensor([[-0.9], [0.0], [0.5], [1.2]], dtype=torch.float64, requires_grad=True)
    scale = torch.full((4, 1), 0.5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda m, s: critic.mean_state_value(observation, m, s), (loc, scale))


def test_moments_come_from_any_policy_that_writes_loc_and_scale():
    spec = Bounded(-2.0, 2.0, shape=(1,))
    policy = gaussian_policy(LinearController(2, 1), spec, std=0.3)
    data = TensorDict({"observation": torch.randn(5, 2)}, (5,))
    loc, scale = action_moments(policy, data)
    assert torch.equal(loc, torch.zeros(5, 1))
    torch.testing.assert_close(scale, torch.full((5, 1), 0.6))
    assert set(data.keys()) == {"observation"}
