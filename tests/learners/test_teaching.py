"""How the critic lives through policy updates: targets, replay, ageing; that every option runs."""

import io
import itertools
from typing import Any, get_args

import jaxtyping
import pytest
import torch

import envs
from torch_gprl.critics import EstimatorName, KernelName, kernels_by_name
from torch_gprl.gp import AgeAwareScore
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig, teaching
from torch_gprl.learners.config import BY_STATE_VALUES, Optimiser

ENVS, STEPS = 4, 25


def learner(
    updates: int = 3, learners: int = 2, task: str = "pendulum-balance", **numbers: Any
) -> PolicyGradient:
    env = envs.make(task, learners=learners, num_envs=ENVS, seed=3, dtype=torch.float64, threads=1)
    defaults = {"rollout_steps": STEPS, "budget": 30, "horizon": 20}
    return PolicyGradient(
        env, PolicyGradientConfig(total_frames=updates * ENVS * STEPS, **(defaults | numbers))
    )


@pytest.mark.parametrize("targets", ["returns", "differences"])
@pytest.mark.parametrize("name", get_args(EstimatorName))
def test_every_estimator_moves_every_parameter(name, targets):
    made = learner(2, estimator=name, targets=targets)
    before = {key: parameter.clone() for key, parameter in made.policy.named_parameters()}
    for figures in made.train():
        assert (figures["gradient_norm"] > 0).all()
        assert (figures["gradient_cosine"].abs() <= 1).all()
        assert (figures["value_error"] > 0).all()
    assert all(not torch.equal(before[key], new) for key, new in made.policy.named_parameters())


@pytest.mark.parametrize("name", BY_STATE_VALUES)
def test_every_estimator_by_state_values_serves_a_neural_critic(name):
    made = learner(2, estimator=name, critic="neural")
    before = {key: parameter.clone() for key, parameter in made.policy.named_parameters()}
    for figures in made.train():
        assert (figures["gradient_norm"] > 0).all()
        assert "basis_size" not in figures
    assert all(not torch.equal(before[key], new) for key, new in made.policy.named_parameters())


@pytest.mark.parametrize("optimiser", get_args(Optimiser))
def test_every_optimiser_moves_the_policy(optimiser):
    made = learner(2, optimiser=optimiser, estimator="return")
    before = [parameter.clone() for parameter in made.policy.parameters()]
    list(made.train())
    assert all(not torch.equal(old, new) for old, new in zip(before, made.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    ("name", "targets"), [*((name, "returns") for name in get_args(KernelName)), ("geodesic", "differences")]
)
def test_every_kernel_serves(name, targets, monkeypatch):
    monkeypatch.setattr(teaching, "FIRST_FIT", 8)
    monkeypatch.setattr(kernels_by_name, "LOOKAHEAD_OF_ACTIONS", 3)
    made = learner(2, kernel=name, targets=targets, visited=120)
    for figures in made.train():
        assert (figures["gradient_norm"] > 0).all()
        assert figures["explained_variance"].isfinite().all()


def test_exploration_is_learned_or_fixed_or_on_schedule():
    spreads = {}
    for exploration in ("learned", "fixed", "scheduled"):
        made = learner(updates=4, exploration=exploration, final_std=0.1)
        half = made.policy.head.half_range
        spreads[exploration] = torch.stack([figures["sigma"] / half for figures in made.train()])[:, 0]
    torch.testing.assert_close(spreads["fixed"], torch.full((4,), 0.5).double())
    torch.testing.assert_close(spreads["scheduled"], torch.tensor([0.5, 0.4, 0.3, 0.2]).double())  # as acted
    assert (made.policy.std / half - 0.1).abs().max() < 1e-6
    assert not torch.isclose(spreads["learned"][-1], spreads["fixed"][-1])


def test_the_gradient_is_that_of_the_whole_rollout():
    made = learner(updates=1)
    grads = {}
    made.optimiser.zero_grad = lambda: [setattr(p, "grad", None) for p in made.policy.parameters()]
    original = made._differentiate

    def both(rollout, parameters):
        figures = original(rollout, parameters)
        grads["halves"] = [p.grad.clone() for p in parameters]
        made.policy.zero_grad()
        made.losses[0](rollout)["loss_objective"].backward()
        grads["whole"] = [p.grad.clone() for p in parameters]
        return figures

    made._differentiate = both
    list(made.train())
    for halves, whole in zip(grads["halves"], grads["whole"], strict=True):
        torch.testing.assert_close(halves, whole, rtol=1e-9, atol=1e-12)


def test_a_replay_keeps_the_newest_transitions_and_the_critic_knows_no_others():
    made = learner(updates=4, targets="differences", replay=150)
    for figures in made.train():
        steps = min(made.updates * ENVS * STEPS, 150)
        assert (made.critic.gp.observations == steps).all()
        assert (figures["outdated"] == 0).all()


@pytest.mark.parametrize("count", [70, 40])
def test_what_is_solved_and_where_the_policy_improves_cover_the_experience(count, monkeypatch):
    monkeypatch.setattr(teaching, "IMPROVED_STATES", 40)
    made = learner(updates=2, targets="differences", replay=200, solved=70)
    list(made.train())
    solved = made.experience.all().gather(1, made.teacher.solved)
    assert made.critic.gp.observations.tolist() == [solved.shape[-1]] * 2 == [70] * 2
    some, everything = (solved, made.experience.all()) if count == 70 else (made.teacher.landmarks(), solved)
    assert some.numel() == 2 * count
    inputs = made.critic.inputs(everything["observation"], everything["action"])
    kept = made.critic.inputs(some["observation"], some["action"]) / inputs.std(1, keepdim=True)
    missed = torch.cdist(inputs / inputs.std(1, keepdim=True), kept).amin(2).amax(1)
    apart = torch.stack([torch.pdist(points).min() for points in kept])
    assert (missed > 0).all()  # not all are chosen
    # a step was left out for one nearer than that, which gave way to one nearer than that
    assert (missed <= 2 * apart).all()


def test_improvements_move_the_policy_by_what_is_remembered():
    moved = {}
    for improvements in (0, 3):
        numbers = {"estimator": "all-action", "targets": "differences", "replay": 100}
        made = learner(updates=1, improvements=improvements, **numbers)
        (figures,) = made.train()
        assert figures["gradient_norm"].shape == (2,)
        moved[improvements] = torch.cat([p.detach().flatten(1) for p in made.controller.parameters()], 1)
        assert (made.critic.gp.observations == 100).all()
    assert ((moved[3] - moved[0]).norm(dim=1) > 0.1).all()


def test_a_critic_renewed_at_every_update_has_nothing_out_of_date():
    renewed = [figures["outdated"] for figures in learner(3, renew_every=1).train()]
    kept = [figures["outdated"] for figures in learner(6, renew_every=1000, novelty_threshold=1e-4).train()]
    assert all((share == 0).all() for share in renewed)
    assert (kept[-1] > 0.3).all()


def test_age_makes_the_critic_forget_its_oldest_basis_vectors():
    oldest = {}
    for weight in (0.0, 1.0):
        made = learner(15, age_weight=weight, renew_every=1000, novelty_threshold=1e-4)
        gp = made.critic.gp
        assert isinstance(gp.pruning, AgeAwareScore) == bool(weight)
        list(made.train())
        oldest[weight] = gp.stamps.masked_fill(~gp.mask, made.updates).amin(-1)
    # the critic was last renewed at update 8, and information alone has kept vectors from there
    assert (oldest[0.0] == 8).all()
    assert (oldest[1.0] > 8).any()


DIFFERENCES = {"targets": "differences", "estimator": "all-action"}


@pytest.mark.parametrize(
    "numbers",
    [
        DIFFERENCES,
        DIFFERENCES | {"replay": 150, "solved": 60, "improvements": 3, "average_over": 5},
        {"critic": "neural"},
    ],
    ids=str,
)
def test_a_saved_run_goes_on_as_it_would_have(numbers):
    numbers = {"updates": 4, **numbers}
    made, other = learner(**numbers), learner(**numbers)
    training = made.train()
    list(itertools.islice(training, 2))
    training.close()
    file = io.BytesIO()
    torch.save({"learner": made.state_dict(), "env": made.env.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    other.load_state_dict(saved["learner"])
    other.env.load_state_dict(saved["env"])
    for one, two in zip(made.train(), other.train(), strict=True):
        assert all(torch.equal(one[key].nan_to_num(), two[key].nan_to_num()) for key in one)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"kernel": "linear"}, "kernel must be one of squared-exponential, matern-1/2"),
        ({"kernel": "successor", "discount": 1.0}, "'successor' needs a discount between 0 and 1, got 1.0"),
        ({"replay": 100}, "needs targets 'differences'"),
        ({"replay": 9, "targets": "differences", "discount": 1.0}, "replay needs a discount between 0 and 1"),
        ({"damping": 0.0}, "damping must be positive"),
        ({"improvements": 2}, "improvements need a replay, estimator 'all-action'"),
        ({"average_over": 5, "exploration": "gibbs"}, "'gibbs' .* needs average_over 1, got 5"),
        ({"replay": -1}, "replay must be at least 0"),
        ({"age_weight": 1.5}, "age_weight must lie between 0 and 1, got 1.5"),
        ({"noise": 0.0}, "noise must be positive"),
    ],
)
def test_numbers_out_of_range_are_refused(numbers, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        PolicyGradientConfig(**numbers)
