"""Gibbs exploration in three action dimensions: candidates and Hamiltonian Monte Carlo, by brute force."""

from typing import Any

import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from tests.policies.gibbs_cases import box, gibbs, here, plain_log_density
from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import GibbsConfig, GibbsPolicy, NoiseStream
from torch_gprl.policies.candidate_density import Proposal
from torch_gprl.policies.gibbs_energy import Window
from torch_gprl.policies.hamiltonian import HamiltonianConfig, HamiltonianSampler, reflect

DIMS, BINS, FINE = 3, 4, 32
LOW, HIGH = (bound.double() for bound in box(DIMS))
SAMPLERS = ["candidates", "hamiltonian"]


def policy(**options: Any) -> GibbsPolicy:
    return gibbs(DIMS, GibbsConfig(**{"inverse_temperature": 6.0, "points": 64} | options))


def brute_force(acting: GibbsPolicy, state: Tensor) -> tuple[Tensor, Tensor]:
    """Midpoints of 32³ cells [P, 3] and the probability of each."""
    middle = (torch.arange(FINE, dtype=torch.float64) + 0.5) / FINE
    action = LOW + torch.cartesian_prod(middle, middle, middle) * (HIGH - LOW)
    opinion = acting.head.opinion(state, acting.head.mean_at(state), torch.zeros(1, 1, DIMS))
    ends = torch.stack([opinion["least"], opinion["least"] + opinion["extent"]])
    return action, plain_log_density(acting, state, action, ends).detach().softmax(0)


def bins(action: Tensor) -> Tensor:
    """Which of 4³ cells each action [P, 3] lies in."""
    index = ((action - LOW) / (HIGH - LOW) * BINS).long().clamp(0, BINS - 1)
    return index @ torch.tensor([BINS**2, BINS, 1])


@pytest.mark.parametrize("form", ["printed", "robust"])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_actions_follow_the_density(form, sampler):
    acting, count = policy(form=form, sampler=sampler), 1_500
    state = here(1)["observation"]
    action, probability = brute_force(acting, state)
    if acting.chains is not None:
        for _ in range(10):  # tune the step
            acting(here(50))
        assert 0.5 < acting.chains.acceptance.item() < 0.99
    drawn = acting(here(count))["action"].reshape(-1, DIMS)
    assert ((drawn >= LOW) & (drawn <= HIGH)).all()
    observed = torch.bincount(bins(drawn), minlength=BINS**DIMS).double()
    expected = torch.zeros_like(observed).index_add(0, bins(action), probability) * count
    rare = expected < 5  # taken together, with one that is not
    rare[expected.argmax()] = True
    observed, expected = (torch.cat([t[~rare], t[rare].sum().reshape(1)]) for t in (observed, expected))
    # one failure in 10⁴ seeds
    assert stats.chisquare(observed.numpy(), expected.numpy()).pvalue > 1e-4


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_log_probability_and_entropy_are_those_of_the_density(sampler):
    acting = policy(points=4096, sampler=sampler)
    data = acting(here(1))
    action, probability = brute_force(acting, data["observation"])
    volume = ((HIGH - LOW) / FINE).prod()
    density = acting.get_dist(data)
    assert abs(density.entropy().item() + (probability * (probability / volume).log()).sum()) < 0.02
    torch.testing.assert_close(density.mean.flatten(), probability @ action, rtol=0.02, atol=0.02)
    fresh = acting.get_dist(data.select("observation"))
    for found in (density.log_prob(data["action"]), fresh.log_prob(data["action"])):
        torch.testing.assert_close(found, data["action_log_prob"], rtol=0, atol=0.05)
    index = probability.argmax()
    found = fresh.log_prob(action[index].reshape(1, 1, DIMS))
    assert abs(found.item() - (probability[index] / volume).log().item()) < 0.05


def test_the_score_agrees_with_finite_differences_and_has_mean_zero():
    acting = policy()
    weight = acting.head.greedy.controller.weight
    data = acting(here(1))

    def log_prob() -> Tensor:
        return acting.get_dist(data).log_prob(data["action"]).sum()

    (score,) = torch.autograd.grad(log_prob(), weight)
    step = 1e-5 * torch.randn_like(weight)
    with torch.no_grad():
        weight.add_(step)
        above = log_prob()
        weight.sub_(2 * step)
        below = log_prob()
        weight.add_(step)
    torch.testing.assert_close(above - below, 2 * (score * step).sum(), rtol=1e-6, atol=1e-10)
    assert score.abs().max() > 1e-3

    many = acting(here(1_000))
    scores = acting.get_dist(many).log_prob(many["action"])
    (mean,) = torch.autograd.grad(scores.mean(), weight)
    # the score of f is at most the window's slope, a few over σ_e, of standard deviation about 1/σ_e
    bound = 6 * (2 / 0.5) * here(1)["observation"].abs().max() / 1_000**0.5
    assert mean.abs().max() < bound


def test_importance_weights_carry_samples_to_another_controller():
    acting = policy()
    data = acting(here(3_000))
    with torch.no_grad():
        acting.head.greedy.controller.bias.add_(0.1)
        weight = (acting.get_dist(data).log_prob(data["action"]) - data["action_log_prob"]).exp()
    assert (weight.mean() - 1).abs() < 6 * weight.std() / 3_000**0.5  # six standard errors


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_what_a_learner_does_does_not_depend_on_the_others(sampler):
    config = GibbsConfig(points=32, sampler=sampler)
    together, alone = gibbs(DIMS, config, learners=3), gibbs(DIMS, config)
    alone.noise = NoiseStream(0, [1])
    for name, mine in alone.head.critic.named_buffers():
        theirs = together.head.critic.get_buffer(name)
        mine.copy_(theirs if theirs.shape == mine.shape else theirs[1:2])
    with torch.no_grad():
        alone.head.greedy.controller.weight.copy_(together.head.greedy.controller.weight[1:2])
    for _ in range(3):
        state = torch.randn(3, 4, 2, dtype=torch.float64)
        expected = together(TensorDict({"observation": state}, (3, 4)))["action"][1:2]
        found = alone(TensorDict({"observation": state[1:2]}, (1, 4)))["action"]
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_the_policy_gradient_loss_trains_the_greedy_map(sampler):
    acting = policy(sampler=sampler)
    data = acting(here(6))
    data["advantage"] = torch.randn(1, 6, 1, dtype=torch.float64)
    PolicyGradientLoss(acting)(data)["loss_objective"].backward()
    gradient = acting.head.greedy.controller.bias.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    assert gradient.any()


def test_candidates_estimate_integrals_over_the_box():
    proposal = Proposal(LOW, HIGH, 4096)
    window = Window(torch.tensor([[5.0, 0.0, -1.0]]), torch.tensor([[0.5, 1.0, 0.2]]))  # one middle outside
    drawn = proposal.draw(window, torch.rand(1, DIMS, dtype=torch.float64))
    assert ((drawn.action >= LOW) & (drawn.action <= HIGH)).all()
    weight = (-drawn.log_proposal).exp()
    volume = (HIGH - LOW).prod()
    assert abs(weight.mean() / volume - 1) < 0.01
    mean = (weight.unsqueeze(-1) * drawn.action).mean(1).squeeze() / volume
    assert ((mean - (LOW + HIGH) / 2).abs() < 0.02).all()


def test_a_mirror_keeps_points_in_the_box_and_is_undone_by_going_back():
    position, momentum = 2 * torch.rand(1000, 2) - 1, 5 * torch.randn(1000, 2)
    there, turned = reflect(position + momentum, momentum)
    assert (there.abs() <= 1).all()
    back, _ = reflect(there - turned, -turned)
    torch.testing.assert_close(back, position, atol=1e-5, rtol=0)


def test_the_step_size_is_tuned_for_each_learner_and_then_left_alone():
    config = HamiltonianConfig(trajectories=1, steps=4, warm_up=200)
    sampler = HamiltonianSampler(2, config)
    width = torch.tensor([0.02, 0.2], dtype=torch.float64).reshape(2, 1, 1)
    position = torch.zeros(2, 100, 2, dtype=torch.float64)
    for _ in range(200):
        normal = torch.randn(2, 100, sampler.random_numbers(2), dtype=torch.float64)
        position = sampler.move(lambda x: -0.5 * (x / width).square().sum(-1), position, normal)
    assert ((sampler.acceptance - 0.8).abs() < 0.2).all()
    assert 4 < sampler.step_size[1] / sampler.step_size[0] < 25  # ten times wider, ten times the step
    before = sampler.step_size.clone()
    sampler.move(lambda x: -0.5 * (x / width).square().sum(-1), position, normal)
    assert torch.equal(sampler.step_size, before)
    torch.testing.assert_close(position.std((1, 2)), width.flatten(), rtol=0.2, atol=0)


@pytest.mark.parametrize("count", [2, 5])
def test_candidates_that_do_not_come_in_halves_are_refused(count):
    with pytest.raises(ValueError, match="an even number of at least 4"):
        Proposal(LOW, HIGH, count)


@pytest.mark.parametrize("options", [{"steps": 0}, {"acceptance": 1.0}])
def test_chains_that_cannot_move_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        HamiltonianConfig(**options)
