"""Temporal differences: the critic learns the value of any Gaussian policy from anyone's transitions.

The scalar problem s' = a s + b u without noise, reward −(q s² + r u²), discount γ, has a quadratic value: for
u ~ N(−K s, σ²), V(s) = −(p s² + c) with p = q + rK² + γ p (a − bK)² and c = (rσ² + γ p b²σ²)/(1 − γ).
"""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer

from torch_gprl.critics import GPActionValue, correlation, interval_coverage
from torch_gprl.gp import Posterior, SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.policies import GaussianPolicy, LinearController, gaussian_policy

A, B, STATE_COST, ACTION_COST, DISCOUNT, STD = 0.9, 0.5, 1.0, 0.1, 0.9, 0.3


def policy(gain: float, *batch: int) -> GaussianPolicy:
    controller = LinearController(1, 1, batch).double()
    with torch.no_grad():
        controller.weight.fill_(-gain)
    return gaussian_policy(controller, Bounded(-1.0, 1.0, shape=(1,), dtype=torch.float64), STD)


def transitions(*shape: int) -> TensorDict:
    """States and actions drawn evenly, whatever any policy would do; none is terminal."""
    state, action = (4 * torch.rand(*shape, 1, dtype=torch.float64) - 2 for _ in range(2))
    following = {
        "observation": A * state + B * action,
        "reward": -(STATE_COST * state.square() + ACTION_COST * action.square()),
        "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
    }
    return TensorDict({"observation": state, "action": action, "next": TensorDict(following, shape)}, shape)


def true_values(gain: float, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """V(s) and Q(s, u)."""
    p = (STATE_COST + ACTION_COST * gain**2) / (1 - DISCOUNT * (A - B * gain) ** 2)
    c = (ACTION_COST + DISCOUNT * p * B**2) * STD**2 / (1 - DISCOUNT)
    ahead = -(p * (A * state + B * action).square() + c)
    reward = -(STATE_COST * state.square() + ACTION_COST * action.square())
    return -(p * state.square() + c), reward + DISCOUNT * ahead


def critic(data: TensorDict, *batch: int) -> GPActionValue:
    gp = SparseOnlineGP(SquaredExponential(2, 2.0, batch_shape=batch), 60, 1e-4)
    made = GPActionValue(gp).requires_grad_(False)
    made.standardise(data["observation"], data["action"], 10 * data["next", "reward"])
    return made


def errors(made: GPActionValue, gain: float, learner: int | None = None) -> tuple[float, float]:
    """Root mean square errors of V and Q, in standard deviations of the truth."""
    data = transitions(*made.gp.batch_shape, 300)
    value, action_value = true_values(gain, data["observation"], data["action"])
    loc = -gain * data["observation"]
    mine = made.mean_state_value(data["observation"], loc, torch.full_like(loc, STD))
    taken = made.mean_value(data["observation"], data["action"])
    pairs = ((mine, value.squeeze(-1)), (taken, action_value.squeeze(-1)))
    rows = slice(None) if learner is None else learner
    v, q = (((a - b)[rows].square().mean().sqrt() / b[rows].std()).item() for a, b in pairs)
    return v, q


@pytest.mark.parametrize("gain", [0.0, 0.8])
def test_it_learns_the_value_of_a_policy_that_made_none_of_the_data(gain):
    data = transitions(600)
    made = critic(data)
    made.update_differences(data, policy(gain), DISCOUNT)
    assert max(errors(made, gain)) < 0.03


@pytest.mark.parametrize("at_once", [False, True])
def test_after_a_terminal_step_nothing_follows(at_once):
    data = transitions(400)
    data["next", "terminated"].fill_(True)
    data["next", "observation"].fill_(torch.nan)  # whatever a simulator leaves there
    made = critic(data)
    if at_once:
        made.cover(data["observation"], data["action"], torch.ones(2).double())
        made.resolve(data, policy(0.5), DISCOUNT)
    else:
        made.update_differences(data, policy(0.5), DISCOUNT)
    seen = made.mean_value(data["observation"], data["action"])
    error = seen - data["next", "reward"].squeeze(-1)
    assert error.square().mean().sqrt() < 0.02 * data["next", "reward"].std()


def test_solving_anew_leaves_nothing_of_an_older_policy():
    data, (old, new) = transitions(600), (0.0, 0.8)
    made = critic(data)
    made.update_differences(data, policy(old), DISCOUNT)
    mixed = copy.deepcopy(made)
    mixed.update_differences(data, policy(new), DISCOUNT)
    made.resolve(data, policy(new), DISCOUNT)
    assert max(errors(made, new)) < 0.03
    assert max(errors(mixed, new)) > 5 * max(errors(made, new))


def test_solving_anew_from_a_replay_buffer_serves_every_learner_its_own():
    gains = (0.0, 0.8)
    actor = policy(0.0, 2)
    with torch.no_grad():
        actor.head.controller.get_parameter("weight").copy_(-torch.tensor(gains).reshape(2, 1, 1))
    data = transitions(2, 600)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(600))
    buffer.extend(data.transpose(0, 1))
    made = critic(data, 2)
    made.cover(data["observation"], data["action"], torch.ones(2).double())
    made.resolve(buffer[:].transpose(0, 1), actor, DISCOUNT)
    for learner, gain in enumerate(gains):
        assert errors(made, gain, learner)[1] < 0.03


def test_targets_are_differences_of_standard_values():
    made = critic(transitions(50))
    value, following = torch.randn(2, 50, 1, dtype=torch.float64)
    whole = made.standard_targets(value - DISCOUNT * following, DISCOUNT)
    parts = made.standard_targets(value) - DISCOUNT * made.standard_targets(following)
    torch.testing.assert_close(whole, parts, rtol=1e-10, atol=1e-10)


# ---------------------------------------------------------------- calibration


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_intervals_of_a_calibrated_posterior_cover_as_often_as_they_say(level):
    mean, variance = torch.randn(3, 20_000).double(), torch.rand(3, 20_000).double() + 0.1
    truth = mean + variance.sqrt() * torch.randn(3, 20_000).double()
    covered = interval_coverage(Posterior(mean, variance), truth, level)
    error = 5 * (level * (1 - level) / 20_000) ** 0.5  # fails once in a million draws
    torch.testing.assert_close(covered, torch.full((3,), level).double(), rtol=0, atol=error)
    assert (interval_coverage(Posterior(mean, variance / 4), truth, level) < level - 0.1).all()


def test_a_level_is_a_probability():
    with pytest.raises(ValueError, match="level must lie between 0 and 1, got 1"):
        interval_coverage(Posterior(torch.zeros(2), torch.ones(2)), torch.zeros(2), 1.0)


def test_correlation_is_that_of_torch():
    one, other = torch.randn(2, 4, 30, dtype=torch.float64)
    found = correlation(one, one + other)
    for row in range(4):
        expected = torch.corrcoef(torch.stack([one[row], (one + other)[row]]))[0, 1]
        torch.testing.assert_close(found[row], expected, rtol=1e-12, atol=1e-12)
