"""Gibbs exploration in one dimension: its density, its score, its limits, and its life with the losses."""

import jaxtyping
import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

import envs
from tests.policies.gibbs_cases import box, gibbs, here, plain_log_density
from torch_gprl.critics import GPActionValue, GPValueEstimator
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import (
    ConfidenceScale,
    GibbsConfig,
    GibbsPolicy,
    LinearController,
    NoiseStream,
    ScaledController,
)

LOW, HIGH = (bound.item() for bound in box(1))
FORMS = ["printed", "robust"]
FINE = torch.linspace(LOW, HIGH, 4001, dtype=torch.float64).unsqueeze(-1)


def brute_force(policy: GibbsPolicy) -> torch.Tensor:
    """The normalised density at the points of FINE, by the trapezoidal rule."""
    state = here(1)["observation"]
    value_range = policy.head.critic.value(state.expand(1, len(FINE), -1), FINE.unsqueeze(0)).mean
    density = plain_log_density(policy, state, FINE, value_range).exp()
    return (density / torch.trapezoid(density, FINE.squeeze(-1))).detach()


@pytest.mark.parametrize("form", FORMS)
def test_actions_follow_the_density(form):
    policy = gibbs(1, GibbsConfig(form=form, inverse_temperature=8.0))
    actions = policy(here(10_000))["action"].flatten()
    edges = torch.linspace(LOW, HIGH, 21, dtype=torch.float64)
    observed = torch.histogram(actions, edges).hist
    density = brute_force(policy)
    cells = torch.bucketize(FINE.squeeze(-1), edges[1:-1])
    expected = torch.zeros(20, dtype=torch.float64).index_add(0, cells, density)
    # one failure in 10⁴ seeds
    assert stats.chisquare(observed.numpy(), (expected / expected.sum() * 10_000).numpy()).pvalue > 1e-4


@pytest.mark.parametrize("form", FORMS)
def test_the_log_probability_is_that_of_the_equation(form):
    policy = gibbs(1, GibbsConfig(form=form, inverse_temperature=8.0, points=401))
    data = policy(here(50))
    actions = data["action"].reshape(-1, 1)
    state = here(1)["observation"]
    value_range = policy.head.critic.value(state.expand(1, len(FINE), -1), FINE.unsqueeze(0)).mean
    log_density = plain_log_density(policy, state, FINE, value_range)
    log_mass = torch.trapezoid(log_density.exp(), FINE.squeeze(-1)).log()
    expected = (plain_log_density(policy, state, actions, value_range) - log_mass).detach()
    assert (data["action_log_prob"].flatten() - expected).abs().max() < 1e-3  # of the grid
    again = policy.get_dist(data).log_prob(data["action"])
    torch.testing.assert_close(again, data["action_log_prob"])
    fresh = policy.get_dist(data.select("observation")).log_prob(data["action"])
    torch.testing.assert_close(fresh, data["action_log_prob"])


def test_without_guidance_the_printed_form_is_uniform():
    policy = gibbs(1, GibbsConfig(form="printed"))
    policy.head.inverse_temperature.zero_()
    density = policy.get_dist(here(3))
    expected = torch.full((1, 3), -torch.tensor(HIGH - LOW).log().item(), dtype=torch.float64)
    torch.testing.assert_close(density.log_prob(torch.zeros(1, 3, 1)), expected)


def test_full_guidance_is_the_best_action():
    policy = gibbs(1, GibbsConfig(inverse_temperature=1e6))
    state = here(1)["observation"]
    value = policy.head.critic.value(state.expand(1, len(FINE), -1), FINE.unsqueeze(0)).mean[0]
    actions = policy(here(50))["action"]
    assert (actions - FINE[value.argmax()]).abs().max() <= 2 * (HIGH - LOW) / 100


@pytest.mark.parametrize("form", FORMS)
def test_the_score_agrees_with_finite_differences_and_has_mean_zero(form):
    policy = gibbs(1, GibbsConfig(form=form, inverse_temperature=8.0))
    weight = policy.head.greedy.controller.weight
    data = policy(here(1))

    def log_prob(action: torch.Tensor) -> torch.Tensor:
        return policy.get_dist(data).log_prob(action)

    (score,) = torch.autograd.grad(log_prob(data["action"]).sum(), weight)
    step = 1e-5 * torch.randn_like(weight)
    with torch.no_grad():
        weight.add_(step)
        above = log_prob(data["action"])
        weight.sub_(2 * step)
        below = log_prob(data["action"])
        weight.add_(step)
    torch.testing.assert_close((above - below).sum(), 2 * (score * step).sum(), rtol=1e-6, atol=1e-12)

    # Σ π ∇ log π = ∇ Σ π over a grid on which the density is linear
    grid = policy.head.cover.candidates.unsqueeze(0)
    mass = policy.get_dist(data.expand(1, grid.shape[1])).log_prob(grid).exp()
    (mean,) = torch.autograd.grad(torch.trapezoid(mass, grid.squeeze(-1)).sum(), weight)
    assert mean.abs().max() < 1e-12
    assert score.abs().max() > 1e-3


@pytest.mark.parametrize("form", FORMS)
def test_the_score_is_beta_times_the_window_less_its_mean(form):
    policy = gibbs(1, GibbsConfig(form=form, inverse_temperature=4.0, points=401))
    state, β = here(1)["observation"], 4.0
    loc = policy.head.mean_at(state).item()
    width = policy.head.config.width * (HIGH - LOW) / 2
    action, density = FINE.squeeze(-1), brute_force(policy)
    # (.17): β Q̃ ∂D/∂f for the printed form, (a − f)/σ_e² for the robust one
    value = policy.head.critic.value(state.expand(1, len(FINE), -1), FINE.unsqueeze(0)).mean[0].detach()
    slope = (action - loc) / width**2
    if form == "printed":
        preference = (value - value.min()) / (value.max() - value.min())
        slope = β * preference * slope * torch.exp(-0.5 * ((action - loc) / width) ** 2)
    expected = slope - torch.trapezoid(density * slope, action)
    some = torch.arange(300, 3800, 500)
    bias = policy.head.greedy.controller.bias
    half = (HIGH - LOW) / 2  # ∂f/∂bias
    for index in some:
        log_prob = policy.get_dist(here(1)).log_prob(FINE[index].reshape(1, 1, 1))
        (found,) = torch.autograd.grad(log_prob.sum(), bias)
        assert abs(found.item() - half * expected[index].item()) < 0.02 * half * expected.abs().max()


def test_importance_weights_carry_samples_to_another_controller():
    policy = gibbs(1, GibbsConfig(inverse_temperature=4.0))
    data = policy(here(10_000))
    with torch.no_grad():
        policy.head.greedy.controller.bias.add_(0.1)
        new = policy.get_dist(data)
        weight = (new.log_prob(data["action"]) - data["action_log_prob"]).exp()
    # six standard errors
    assert (weight.mean() - 1).abs() < 6 * weight.std() / 100
    moved = weight * (data["action"] - new.mean).squeeze(-1)
    assert moved.mean().abs() < 6 * moved.std() / 100


def test_entropy_falls_as_guidance_grows():
    policy = gibbs(1, GibbsConfig(inverse_temperature=1.0, final_inverse_temperature=100.0))
    entropies = []
    for share in (0.0, 0.5, 1.0):
        policy.anneal(share)
        entropies.append(policy.get_dist(here(1)).entropy().item())
    assert entropies[0] > entropies[1] > entropies[2]
    assert policy.head.inverse_temperature == 100
    policy.anneal(0.5)
    torch.testing.assert_close(policy.head.inverse_temperature, torch.tensor(10.0, dtype=torch.float64))


@pytest.mark.parametrize("form", FORMS)
def test_an_empty_critic_leaves_the_window_alone(form):
    policy = gibbs(1, GibbsConfig(form=form))
    policy.head.critic.gp.reset()
    density = policy.get_dist(here(1))
    if form == "printed":
        expected = torch.tensor([0.5 * (LOW + HIGH)], dtype=torch.float64)
        torch.testing.assert_close(density.mean.reshape(1), expected)
    else:
        truncated = stats.truncnorm
        loc, width = policy.head.mean_at(here(1)["observation"]).item(), 0.5 * (HIGH - LOW) / 2
        expected = truncated((LOW - loc) / width, (HIGH - loc) / width, loc, width)
        assert abs(density.mean.item() - expected.mean()) < 1e-3
        assert abs(density.stddev.item() - expected.std()) < 1e-3


def test_the_opinion_at_the_time_of_acting_is_what_counts():
    policy = gibbs(1)
    data = policy(here(5))
    policy.head.critic.gp.reset()
    torch.testing.assert_close(policy.get_dist(data).log_prob(data["action"]), data["action_log_prob"])


def test_its_width_may_come_from_the_critics_variance():
    narrow = gibbs(1)
    scale = ConfidenceScale(noise_scale=1.0, floor=0.01, ceiling=1.0)
    wide = GibbsPolicy(narrow.head.greedy, narrow.head.critic, narrow.head.config, confidence=scale)
    far = TensorDict({"observation": torch.full((1, 1, 2), 50.0, dtype=torch.float64)}, (1, 1))
    near = narrow.head.critic.gp.basis[:, :1, :2] * narrow.head.critic.input_scale[:, None, :2]
    near = TensorDict({"observation": near + narrow.head.critic.input_loc[:, None, :2]}, (1, 1))
    widths = [wide(data)["gibbs", "width"].item() for data in (far, near)]
    assert widths[0] == pytest.approx((HIGH - LOW) / 2, rel=0.05)  # the prior's variance is 1
    assert widths[1] < widths[0]


def test_what_a_learner_does_does_not_depend_on_the_others():
    together = gibbs(1, learners=3)
    alone = gibbs(1, learners=1)
    alone.noise = NoiseStream(0, [1])
    critic, whole = alone.head.critic, together.head.critic
    for name, mine in critic.named_buffers():
        theirs = whole.get_buffer(name)
        mine.copy_(theirs if theirs.shape == mine.shape else theirs[1:2])
    with torch.no_grad():
        alone.head.greedy.controller.weight.copy_(together.head.greedy.controller.weight[1:2])
    for _ in range(3):
        state = torch.randn(3, 4, 2, dtype=torch.float64)
        expected = together(TensorDict({"observation": state}, (3, 4)))["action"][1:2]
        found = alone(TensorDict({"observation": state[1:2]}, (1, 4)))["action"]
        torch.testing.assert_close(found, expected)


def test_without_exploration_the_action_is_greedy():
    policy = gibbs(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = policy(here(5))
    assert torch.equal(data["action"], policy.head.mean_at(data["observation"]))


def test_the_policy_gradient_loss_trains_the_greedy_map_and_nothing_else():
    env = envs.make("pendulum-swingup", learners=2, num_envs=3, threads=1)
    low, high = (bound.reshape(-1)[:1] for bound in (env.action_spec.space.low, env.action_spec.space.high))
    kernel = SquaredExponential(4, batch_shape=(2,))
    critic = GPActionValue(SparseOnlineGP(kernel, 20), action_low=low, action_high=high)
    greedy = ScaledController(LinearController(3, 1, (2,)), low, high)
    policy = GibbsPolicy(greedy, critic, noise=NoiseStream(0, range(2)))
    rollout = env.rollout(10, policy)
    assert rollout["action"].dtype == rollout["observation"].dtype
    estimator = GPValueEstimator(critic, policy, 0.9)
    estimator(rollout)
    rollout["value_target"] = rollout["value_target"] + torch.randn(2, 3, 10, 1)
    critic.update(rollout)
    rollout = env.rollout(10, policy)
    rollout["advantage"] = torch.randn(2, 3, 10, 1)
    PolicyGradientLoss(policy)(rollout)["loss_objective"].backward()
    assert [name.rsplit(".", 1)[1] for name, _ in policy.named_parameters()] == ["weight", "bias"]
    gradient = greedy.controller.weight.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert gradient.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inverse_temperature": 0.0}, "inverse temperatures"),
        ({"width": 0.0}, "width"),
        ({"form": "other"}, "form must be printed or robust, got 'other'"),
        ({"sampler": "gibbs"}, "sampler must be candidates or hamiltonian, got 'gibbs'"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        GibbsConfig(**options)
