"""Noise by the critic's confidence: its width, its score, its streams, and its life with the losses."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

import envs
from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import (
    ConfidenceNoise,
    ConfidenceScale,
    LinearController,
    NoiseStream,
    ScaledController,
)

LEARNERS, STATES = 3, 3
LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])
HALF = (HIGH - LOW) / 2
PRIOR = 0.49  # variance of the prior
FREE = ConfidenceScale(noise_scale=0.5, floor=1e-6, ceiling=1e6)  # no bound in reach


def critic(learners: int = LEARNERS, lengthscale: float = 1.0) -> GPActionValue:
    kernel = SquaredExponential(STATES + 2, lengthscale, PRIOR, batch_shape=(learners,))
    return GPActionValue(SparseOnlineGP(kernel, 60, 1e-2), action_low=LOW, action_high=HIGH)


def controller(learners: int = LEARNERS) -> ScaledController:
    linear = LinearController(STATES, 2, (learners,))
    with torch.no_grad():
        linear.weight.copy_(0.3 * torch.randn(STATES, 2))
    return ScaledController(linear, LOW, HIGH)


def teach(value: GPActionValue, states: torch.Tensor, actions: torch.Tensor) -> None:
    target = torch.randn(*states.shape[:-1], 1)
    value.update(
        TensorDict({"observation": states, "action": actions, "value_target": target}, states.shape[:-1])
    )


def test_without_data_the_variance_is_the_priors():
    acting = ConfidenceNoise(controller(), critic(), FREE)
    data = acting(TensorDict({"observation": torch.randn(LEARNERS, 7, STATES)}, (LEARNERS, 7)))
    expected = (math.sqrt(0.5 * PRIOR) * HALF).expand(LEARNERS, 7, 2)
    torch.testing.assert_close(data["action_std"], expected)
    assert torch.equal(data["action_std"], data["scale"])


def test_noise_falls_where_the_critic_has_learned_and_nowhere_rises():
    value = critic()
    acting = ConfidenceNoise(controller(), value, FREE)
    seen, far = torch.randn(LEARNERS, 20, STATES), torch.randn(LEARNERS, 20, STATES) + 20
    stds = []
    for _ in range(2):
        stds.append([acting(TensorDict({"observation": s}, s.shape[:-1]))["action_std"] for s in (seen, far)])
        teach(value, seen, acting.head.mean_at(seen).detach())
    # noise 0.01 against a prior of 0.49: at most a seventh of the standard deviation is left
    assert (stds[1][0] < stds[0][0] / 6).all()
    torch.testing.assert_close(stds[1][1], stds[0][1])


@pytest.mark.parametrize(("scale", "expected"), [(1e9, 0.8), (0.0, 0.1)])
def test_noise_keeps_between_floor_and_ceiling(scale, expected):
    acting = ConfidenceNoise(controller(), critic(), ConfidenceScale(scale, 0.1, 0.8))
    data = acting(TensorDict({"observation": torch.randn(LEARNERS, 4, STATES)}, (LEARNERS, 4)))
    torch.testing.assert_close(data["action_std"], (expected * HALF).expand(LEARNERS, 4, 2))


def test_repeated_data_leave_no_negative_variance():
    value = critic(lengthscale=3.0)
    states = torch.randn(LEARNERS, 1, STATES).expand(-1, 500, -1) + 1e-7 * torch.randn(LEARNERS, 500, STATES)
    acting = ConfidenceNoise(controller(), value, ConfidenceScale(floor=1e-12, ceiling=1.0))
    for _ in range(20):
        teach(value, states, acting.head.mean_at(states).detach())
    data = acting(TensorDict({"observation": states}, states.shape[:-1]))
    assert (data["action_std"] > 1e-6).all()  # 10⁴ observations of noise 0.01 leave about 0.001


def test_the_score_holds_the_stored_noise_constant():
    value, greedy = critic(), controller()
    acting = ConfidenceNoise(greedy, value, FREE)
    data = acting(TensorDict({"observation": torch.randn(LEARNERS, 5, STATES)}, (LEARNERS, 5))).detach()
    teach(value, data["observation"], data["action"])  # the critic moves on; the data remember
    log_prob = acting.get_dist(data).log_prob(data["action"])
    torch.testing.assert_close(log_prob, data["action_log_prob"], rtol=1e-5, atol=1e-5)
    (found,) = torch.autograd.grad(log_prob.sum(), greedy.controller.weight)
    # ∂ log N/∂W = Σ s ((a − f)/σ²)ᵀ · half range
    slope = (data["action"] - data["loc"]) / data["action_std"].square() * HALF
    torch.testing.assert_close(found, data["observation"].mT @ slope, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("exact", [False, True])
def test_the_score_has_mean_zero_and_agrees_with_finite_differences(exact):
    value, greedy = critic(1), controller(1).double()
    acting = ConfidenceNoise(greedy, value, FREE, exact=exact).double()
    teach(value, torch.randn(1, 30, STATES), torch.randn(1, 30, 2))
    state = torch.randn(1, 1, STATES, dtype=torch.float64)
    here = TensorDict({"observation": state}, (1, 1))
    used = acting(here.clone())["action_std"].detach()
    action = acting(here.clone())["action"].detach() + 0.3
    weight = greedy.controller.weight

    def log_prob() -> torch.Tensor:
        data = TensorDict({"observation": state, "action_std": used}, (1, 1))
        return acting.get_dist(data).log_prob(action).sum()

    (score,) = torch.autograd.grad(log_prob(), weight)
    step = 1e-6 * torch.randn_like(weight)
    with torch.no_grad():
        weight.add_(step)
        above = log_prob()
        weight.sub_(2 * step)
        below = log_prob()
        weight.add_(step)
    torch.testing.assert_close(above - below, 2 * (score * step).sum(), rtol=1e-5, atol=1e-12)

    many = here.expand(1, 10_000).clone()
    with torch.no_grad():
        actions = acting(many.clone())["action"]
    mean_score = torch.autograd.grad(acting.get_dist(many).log_prob(actions).mean(), weight)[0]
    spread = (HALF / used).squeeze() * state.norm() * 3  # bounds a score's standard deviation, σ's part too
    assert (mean_score.abs() < 6 * spread.max() / 10_000**0.5).all()


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MEAN])
def test_without_exploration_the_action_is_greedy(kind):
    acting = ConfidenceNoise(controller(), critic())
    state = torch.randn(LEARNERS, 5, STATES)
    with set_exploration_type(kind):
        data = acting(TensorDict({"observation": state}, (LEARNERS, 5)))
    assert torch.equal(data["action"], acting.head.greedy(state))


def test_what_a_learner_does_does_not_depend_on_the_others():
    together, alone = (
        ConfidenceNoise(controller(len(indices)), critic(len(indices)), FREE, NoiseStream(7, indices))
        for indices in (range(LEARNERS), [1])
    )
    with torch.no_grad():
        for mine, theirs in zip(alone.parameters(), together.parameters(), strict=True):
            mine.copy_(theirs[1:2])
    states, actions = torch.randn(LEARNERS, 30, STATES), torch.randn(LEARNERS, 30, 2)
    target = torch.randn(LEARNERS, 30, 1)
    for acting, rows in ((together, slice(None)), (alone, slice(1, 2))):
        acting.head.critic.gp.update(
            acting.head.critic.inputs(states[rows], actions[rows]), target[rows, :, 0]
        )
    for _ in range(70):
        state = torch.randn(LEARNERS, 4, STATES)
        expected = together(TensorDict({"observation": state}, (LEARNERS, 4)))["action"][1:2]
        found = alone(TensorDict({"observation": state[1:2]}, (1, 4)))["action"]
        torch.testing.assert_close(found, expected)


def test_the_policy_gradient_loss_trains_the_greedy_map_and_nothing_else():
    env = envs.make("pendulum-swingup", learners=2, num_envs=3, threads=1)
    kernel = SquaredExponential(4, batch_shape=(2,))
    low, high = (bound.reshape(-1)[:1] for bound in (env.action_spec.space.low, env.action_spec.space.high))
    value = GPActionValue(SparseOnlineGP(kernel, 20), action_low=low, action_high=high)
    greedy = ScaledController(LinearController(3, 1, (2,)), low, high)
    acting = ConfidenceNoise(greedy, value, noise=NoiseStream(0, range(2)))
    with torch.no_grad():
        rollout = env.rollout(10, acting)
    assert rollout["action_std"].shape == rollout["action"].shape
    rollout["advantage"] = torch.randn(2, 3, 10, 1)
    PolicyGradientLoss(acting)(rollout)["loss_objective"].backward()
    assert {name for name, _ in acting.named_parameters()} == {
        "module.0.greedy.controller.weight",
        "module.0.greedy.controller.bias",
    }
    gradient = greedy.controller.weight.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert gradient.any()


def test_a_critic_without_bounds_is_refused():
    kernel = SquaredExponential(STATES + 2, batch_shape=(LEARNERS,))
    with pytest.raises(ValueError, match="give the critic action_low and action_high"):
        ConfidenceNoise(controller(), GPActionValue(SparseOnlineGP(kernel, 20)))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"noise_scale": -1.0}, "noise_scale"), ({"floor": 0.0}, "floor"), ({"floor": 2.0}, "floor")],
)
def test_numbers_that_make_no_scale_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ConfidenceScale(**options)
