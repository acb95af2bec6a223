"""Returns against their definition and against TorchRL's estimators."""

import pytest
import torch
from torch import Tensor
from torchrl.objectives.value.functional import reward2go, td0_return_estimate, td1_return_estimate

from torch_gprl.critics import k_step_returns

DISCOUNT = 0.875  # exact in single precision, to which TorchRL rounds it
STEPS = 30


def rollout(*batch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rewards, values of the states reached (0 at terminal ones), terminations and ends of episodes."""
    shape = (*batch, STEPS)
    terminated, truncated = torch.rand(shape) < 0.1, torch.rand(shape) < 0.1
    reward, value = torch.randn(2, *shape, dtype=torch.float64)
    return reward, torch.where(terminated, 0.0, value), terminated, terminated | truncated


def by_definition(reward: Tensor, next_value: Tensor, done: Tensor, horizon: int) -> Tensor:
    """The sum of each step of one sequence [T], term by term."""
    returns = torch.zeros_like(reward)
    for t in range(STEPS):
        for i in range(horizon):
            step = t + i
            returns[t] += DISCOUNT**i * reward[step]
            if done[step] or step == STEPS - 1 or i == horizon - 1:
                returns[t] += DISCOUNT ** (i + 1) * next_value[step]
                break
    return returns


@pytest.mark.parametrize("horizon", [1, 2, 5, STEPS, 10 * STEPS])
def test_returns_are_sums_of_real_rewards_and_one_bootstrap(horizon):
    reward, next_value, _, done = rollout(2, 3)
    returns = k_step_returns(reward, next_value, done, DISCOUNT, horizon)
    for learner in range(2):
        for env in range(3):
            row = learner, env
            expected = by_definition(reward[row], next_value[row], done[row], horizon)
            torch.testing.assert_close(returns[row], expected, rtol=1e-12, atol=1e-12)


def test_a_horizon_past_the_end_is_the_monte_carlo_return_bit_for_bit():
    reward, next_value, _, done = rollout(4)
    # backwards: G_t = r_t + γ (V_{t+1} at an end, else G_{t+1})
    following, expected = next_value[:, -1], torch.empty_like(reward)
    for t in range(STEPS - 1, -1, -1):
        following = torch.where(done[:, t], next_value[:, t], following)
        following = reward[:, t] + DISCOUNT * following
        expected[:, t] = following
    for horizon in (STEPS, STEPS + 1, 10**9):
        assert torch.equal(k_step_returns(reward, next_value, done, DISCOUNT, horizon), expected)


def test_without_bootstrap_it_is_torchrls_reward_to_go():
    reward, _, _, done = rollout(4)
    done[:, -1] = True
    expected = reward2go(reward, done, DISCOUNT, time_dim=-1)
    returns = k_step_returns(reward, torch.zeros_like(reward), done, DISCOUNT, STEPS)
    torch.testing.assert_close(returns, expected, rtol=1e-12, atol=1e-12)


def test_it_agrees_with_torchrls_temporal_differences():
    reward, next_value, terminated, done = rollout(4)
    last = done.clone()
    last[:, -1] = True
    value, paid, over, end = (tensor.unsqueeze(-1) for tensor in (next_value, reward, terminated, last))
    one_step = td0_return_estimate(DISCOUNT, value, paid, terminated=over)
    full = td1_return_estimate(DISCOUNT, value, paid, end, over)
    for horizon, expected in ((1, one_step), (STEPS, full)):
        returns = k_step_returns(reward, next_value, done, DISCOUNT, horizon)
        torch.testing.assert_close(returns, expected.squeeze(-1), rtol=1e-12, atol=1e-12)


def test_nothing_flows_from_one_episode_to_the_one_before():
    reward, next_value, _, done = rollout(4)
    done[:, 10] = True
    before = k_step_returns(reward, next_value, done, DISCOUNT, 20)
    reward[:, 11:] += 100
    next_value[:, 11:] += 100
    after = k_step_returns(reward, next_value, done, DISCOUNT, 20)
    assert torch.equal(after[:, :11], before[:, :11])
    assert not (after[:, 11:] == before[:, 11:]).any()


def test_true_values_are_a_fixed_point_at_every_horizon():
    reward, next_value, _, done = rollout(4)
    returns = k_step_returns(reward, next_value, done, DISCOUNT, STEPS)
    last = done.clone()
    last[:, -1] = True
    consistent = torch.where(last, next_value, torch.cat([returns[:, 1:], returns[:, -1:]], -1))
    for horizon in (1, 3, 7):
        torch.testing.assert_close(k_step_returns(reward, consistent, done, DISCOUNT, horizon), returns)


def test_the_data_are_left_alone():
    data = rollout(2)
    copies = [tensor.clone() for tensor in data]
    k_step_returns(data[0], data[1], data[3], DISCOUNT, 5)
    assert all(map(torch.equal, data, copies))


@pytest.mark.parametrize("horizon", [0, -3])
def test_a_horizon_without_rewards_is_refused(horizon):
    reward, next_value, _, done = rollout(1)
    with pytest.raises(ValueError, match=f"horizon must be at least 1 step, got {horizon}"):
        k_step_returns(reward, next_value, done, DISCOUNT, horizon)
