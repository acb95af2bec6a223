"""Bias and noise of every estimator on the scalar linear-quadratic problem, whose gradient is known.

s' = a s + b u + w ε, reward −(q s² + r u²), policy u ~ N(−K s, σ²), H steps from s ~ N(0, 1), as in
`test_linear_quadratic`. The critic is wrong on purpose: it knows nothing of time and discounts nothing.
"""

import functools

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from torch_gprl.critics import USE_ALL_ACTIONS, GPActionValue, GPValueEstimator
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.objectives import AllActionLoss, PolicyGradientLoss
from torch_gprl.policies import GaussianPolicy, LinearController, gaussian_policy

A, B, STATE_COST, ACTION_COST = 0.95, 0.5, 1.0, 0.1
STD, DISTURBANCE = 0.3, 0.05
STEPS, DISCOUNT, GAIN = 25, 0.95, 0.3
GRADIENT = 6.29399  # dJ/dK in closed form
REPLICAS, EPISODES = 100, 100  # independent estimates, as learners, and the episodes of each
STANDARD_ERRORS = 5  # two-sided: a right estimator fails once in 1.7 million seeds
DISCOUNTS = DISCOUNT ** torch.arange(STEPS, dtype=torch.float64).unsqueeze(-1)
UNBIASED = (
    "return",
    "reward-to-go",
    "mean-baseline",
    "optimal-baseline",
    "value-baseline",
    "control-variate",
)


def policy() -> GaussianPolicy:
    controller = LinearController(1, 1, (REPLICAS,)).double()
    with torch.no_grad():
        controller.weight.fill_(-GAIN)
    return gaussian_policy(controller, Bounded(-1.0, 1.0, shape=(1,), dtype=torch.float64), STD)


def episodes(replicas: int, count: int) -> TensorDict:
    """Rollouts [replicas, count, H] that end in a terminal state."""
    shape = (replicas, count)
    states, actions = [torch.randn(shape, dtype=torch.float64)], []
    for _ in range(STEPS):
        actions.append(-GAIN * states[-1] + STD * torch.randn(shape, dtype=torch.float64))
        noise = DISTURBANCE * torch.randn(shape, dtype=torch.float64)
        states.append(A * states[-1] + B * actions[-1] + noise)
    s, u = torch.stack(states, -1).unsqueeze(-1), torch.stack(actions, -1).unsqueeze(-1)
    end = torch.zeros(*shape, STEPS, 1, dtype=torch.bool)
    end[..., -1, :] = True
    following = {
        "observation": s[..., 1:, :],
        "reward": -(STATE_COST * s[..., :-1, :].square() + ACTION_COST * u.square()),
        "terminated": end,
        "done": end,
    }
    shape = (*shape, STEPS)
    return TensorDict(
        {"observation": s[..., :-1, :], "action": u, "next": TensorDict(following, shape)}, shape
    )


@functools.cache
def scene() -> tuple[TensorDict, GPActionValue]:
    """Data, and a critic of other data: the undiscounted returns of 20 episodes."""
    torch.manual_seed(0)
    gp = SparseOnlineGP(SquaredExponential(2, 3.0), 30, 0.1)
    critic = GPActionValue(gp).requires_grad_(False)
    earlier = episodes(1, 20)[0]
    returns = torch.zeros_like(earlier["next", "reward"])
    ahead = torch.zeros(20, 1, dtype=torch.float64)
    for step in reversed(range(STEPS)):
        ahead = earlier["next", "reward"][:, step] + ahead
        returns[:, step] = ahead
    critic.standardise(earlier["observation"], earlier["action"], returns)
    critic.update(earlier.set("value_target", returns))
    return episodes(REPLICAS, EPISODES), critic


@functools.cache
def estimates(name: str, horizon: int = 1) -> Tensor:
    """dJ/dK of each replica, the discounted objective's: scores and states weighed by γ^t."""
    data, critic = scene()
    actor = policy()
    data = GPValueEstimator(critic, actor, DISCOUNT, name, horizon)(data.clone())  # type: ignore[arg-type]
    data["advantage"] = DISCOUNTS * data["advantage"]
    data["state_weight"] = DISCOUNTS.expand_as(data["advantage"])
    PolicyGradientLoss(actor)(data)["loss_objective"].backward()
    if name in USE_ALL_ACTIONS:
        AllActionLoss(actor, critic)(data)["loss_all_action"].backward()
    gradient = actor.head.controller.weight.grad
    assert gradient is not None
    return STEPS * gradient.flatten()  # a mean over time of a loss, and K = −weight


def standard_error(name: str) -> float:
    return (estimates(name).std() / REPLICAS**0.5).item()


@pytest.mark.parametrize("name", UNBIASED)
def test_it_is_unbiased_whatever_the_critic_says(name):
    error = standard_error(name)
    assert abs(estimates(name).mean() - GRADIENT) < STANDARD_ERRORS * error
    assert error < 0.7  # of 6.29: the test would see a wrong factor, or a lost term


def test_a_long_horizon_is_unbiased_too():
    found = estimates("k-step-baseline", STEPS)
    assert torch.equal(found, estimates("value-baseline"))


@pytest.mark.parametrize("name", ["advantage", "all-action"])
def test_the_critic_alone_is_as_biased_as_it_is_wrong(name):
    bias = estimates(name).mean() - GRADIENT
    assert bias > STANDARD_ERRORS * standard_error(name)
    assert bias < GRADIENT  # a critic without discount overrates what actions do, not without measure


def test_the_two_forms_of_the_critics_gradient_agree_but_for_noise():
    one, other = estimates("advantage"), estimates("all-action")
    error = ((one - other).std() / REPLICAS**0.5).item()
    assert abs((one - other).mean()) < STANDARD_ERRORS * error
    assert other.std() < one.std()


def test_what_is_sampled_less_is_less_noisy():
    spread = {name: estimates(name).std().item() for name in (*UNBIASED, "all-action")}
    assert spread["return"] > 1.2 * spread["reward-to-go"]
    assert spread["reward-to-go"] > 1.05 * spread["optimal-baseline"]
    assert spread["optimal-baseline"] > 1.2 * spread["value-baseline"]
    assert spread["optimal-baseline"] > 1.2 * spread["control-variate"]
    assert spread["control-variate"] > 2 * spread["all-action"]
