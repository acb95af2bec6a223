"""The policy gradient on the scalar linear-quadratic problem, whose gradient is known.

s' = a s + b u + w ε, reward −(q s² + r u²), policy u ~ N(−K s, σ²), H steps from s ~ N(0, 1). The state's
variance follows P' = (a − bK)² P + b²σ² + w², and J = −Σ γ^t ((q + rK²) P_t + rσ²).
"""

import functools

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from torch_gprl.critics import k_step_returns
from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import LinearController, gaussian_policy

A, B, STATE_COST, ACTION_COST = 0.95, 0.5, 1.0, 0.1
STD, DISTURBANCE = 0.3, 0.05
STEPS, DISCOUNT, GAIN = 25, 0.95, 0.3
GRADIENT = 6.29399  # dJ/dK
REPLICAS, EPISODES = 100, 500  # independent estimates, as learners, and the episodes of each
STANDARD_ERRORS = 5  # two-sided: a right estimator fails once in 1.7 million seeds

DISCOUNTS = DISCOUNT ** torch.arange(STEPS, dtype=torch.float64)


def performance(gain: float) -> float:
    """J(K) in closed form."""
    variance, total = 1.0, 0.0
    for t in range(STEPS):
        total -= DISCOUNT**t * ((STATE_COST + ACTION_COST * gain**2) * variance + ACTION_COST * STD**2)
        variance = (A - B * gain) ** 2 * variance + B**2 * STD**2 + DISTURBANCE**2
    return total


def value_coefficients() -> tuple[Tensor, Tensor]:
    """p, c [H + 1] of the policy's value with t steps behind it, V_t(s) = −(p_t s² + c_t)."""
    p, c = [0.0], [0.0]
    for _ in range(STEPS):
        spread = B**2 * STD**2 + DISTURBANCE**2
        c.append(ACTION_COST * STD**2 + DISCOUNT * (c[-1] + p[-1] * spread))
        p.append(STATE_COST + ACTION_COST * GAIN**2 + DISCOUNT * p[-1] * (A - B * GAIN) ** 2)
    return (torch.tensor(numbers[::-1], dtype=torch.float64) for numbers in (p, c))  # type: ignore[return-value]


def gradient_by_states(weight: float) -> float:
    """Σ_t weight^t E[∂Q_t/∂u · (−s)], with ∂Q_t/∂u = 2 (rK − γ p_{t+1} b (a − bK)) s at u = −Ks."""
    p, _ = value_coefficients()
    variance, total = 1.0, 0.0
    for t in range(STEPS):
        slope = 2 * (DISCOUNT * p[t + 1].item() * B * (A - B * GAIN) - ACTION_COST * GAIN)
        total += weight**t * variance * slope
        variance = (A - B * GAIN) ** 2 * variance + B**2 * STD**2 + DISTURBANCE**2
    return total


@functools.cache
def episodes() -> tuple[Tensor, Tensor, Tensor]:
    """States [replicas, episodes, H + 1], actions and rewards [replicas, episodes, H]."""
    shape = (REPLICAS, EPISODES)
    states, actions = [torch.randn(shape, dtype=torch.float64)], []
    for _ in range(STEPS):
        actions.append(-GAIN * states[-1] + STD * torch.randn(shape, dtype=torch.float64))
        states.append(
            A * states[-1] + B * actions[-1] + DISTURBANCE * torch.randn(shape, dtype=torch.float64)
        )
    s, u = torch.stack(states, -1), torch.stack(actions, -1)
    return s, u, -(STATE_COST * s[..., :-1].square() + ACTION_COST * u.square())


def estimates(weight: Tensor) -> Tensor:
    """dJ/dK of each replica by the loss, given the weights [replicas, episodes, H] of the scores."""
    states, actions, _ = episodes()
    controller = LinearController(1, 1, (REPLICAS,)).double()
    with torch.no_grad():
        controller.weight.fill_(-GAIN)
    policy = gaussian_policy(controller, Bounded(-1.0, 1.0, shape=(1,), dtype=torch.float64), STD)
    data = {
        "observation": states[..., :-1, None],
        "action": actions.unsqueeze(-1),
        "advantage": weight.unsqueeze(-1),
    }
    PolicyGradientLoss(policy)(TensorDict(data, weight.shape))["loss_objective"].backward()
    assert controller.weight.grad is not None
    return (
        STEPS * controller.weight.grad.flatten()
    )  # a mean over time, and K = −weight: dJ/dK = H ∂loss/∂weight


def returns(horizon: int = STEPS, next_value: Tensor | None = None) -> Tensor:
    _, _, reward = episodes()
    last = torch.zeros(STEPS, dtype=torch.bool)
    last[-1] = True
    following = torch.zeros_like(reward) if next_value is None else next_value
    return k_step_returns(reward, following, last.expand_as(reward), DISCOUNT, horizon)


def full_return() -> Tensor:
    return returns()[..., :1].expand(-1, -1, STEPS)


def full_return_less_its_mean() -> Tensor:
    return full_return() - performance(GAIN)


def reward_to_go() -> Tensor:
    return DISCOUNTS * returns()


def reward_to_go_less_the_value() -> Tensor:
    return DISCOUNTS * (returns() - true_value()[..., :-1])


def one_reward_and_the_value() -> Tensor:
    value = true_value()
    return DISCOUNTS * (returns(1, value[..., 1:]) - value[..., :-1])


def true_value() -> Tensor:
    p, c = value_coefficients()
    return -(p * episodes()[0].square() + c)


def test_the_known_gradient_is_the_slope_of_the_closed_form():
    slope = (performance(GAIN + 1e-6) - performance(GAIN - 1e-6)) / 2e-6
    assert slope == pytest.approx(GRADIENT, abs=1e-5)


def test_the_true_value_is_that_of_the_returns():
    error = returns() - true_value()[..., :-1]
    assert (error.mean((0, 1)).abs() < 5 * error.std((0, 1)) / (REPLICAS * EPISODES) ** 0.5).all()
    assert performance(GAIN) == pytest.approx(
        -sum(x[0].item() for x in value_coefficients()),  # E[s²] = 1 at the start
        rel=1e-12,
    )


@pytest.mark.parametrize(
    "weights",
    [
        full_return,
        full_return_less_its_mean,
        reward_to_go,
        reward_to_go_less_the_value,
        one_reward_and_the_value,
    ],
)
def test_every_unbiased_weight_gives_the_true_gradient(weights):
    found = estimates(weights())
    error = found.std() / REPLICAS**0.5
    assert abs(found.mean() - GRADIENT) < STANDARD_ERRORS * error
    assert error < 0.35  # of 6.29: the test would see a wrong factor


def test_without_discounting_the_weights_it_is_the_gradient_of_something_else():
    assert gradient_by_states(DISCOUNT) == pytest.approx(GRADIENT, abs=1e-5)
    expected = gradient_by_states(1.0)
    assert expected > GRADIENT + 1
    found = estimates(one_reward_and_the_value() / DISCOUNTS)
    assert abs(found.mean() - expected) < STANDARD_ERRORS * found.std() / REPLICAS**0.5


def test_a_baseline_and_a_bootstrap_lower_the_variance():
    spread = [
        estimates(weights()).std() * EPISODES**0.5
        for weights in (full_return, reward_to_go, one_reward_and_the_value)
    ]
    assert spread[0] > 1.2 * spread[1] > 4 * spread[2]
