"""Policy gradients whose exploration the critic guides: that they run, resume, keep apart, and are guided."""

import io
from typing import Any

import jaxtyping
import pytest
import torch

import envs
from torch_gprl.critics import graphs, kernels_by_name
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.policies import ConfidenceNoise, GibbsPolicy

ENVS, STEPS = 2, 20
KINDS = {"confidence": ConfidenceNoise, "gibbs": GibbsPolicy}


def learner(
    exploration: str, learners: int = 2, updates: int = 2, first: int = 0, **options: Any
) -> PolicyGradient:
    env = envs.make(
        "pendulum-swingup",
        learners=learners,
        num_envs=ENVS,
        seed=3,
        first_learner=first,
        dtype=torch.float64,
        threads=1,
    )
    numbers = {"rollout_steps": STEPS, "budget": 25, "optimiser": "adam", "controller": "rbf"} | options
    config = PolicyGradientConfig(total_frames=updates * ENVS * STEPS, exploration=exploration, **numbers)
    return PolicyGradient(env, config, seed=5, first_learner=first)


@pytest.mark.parametrize(("exploration", "optimiser"), [("confidence", "adam"), ("gibbs", "natural")])
def test_it_moves_the_controller_and_nothing_but_the_controller(exploration, optimiser):
    trained = learner(exploration, optimiser=optimiser)
    assert isinstance(trained.policy, KINDS[exploration])
    for figures in trained.train():
        assert all(figure.shape == (2,) for figure in figures.values())
        assert figures["sigma"].isfinite().all()
    assert [name.rsplit(".", 1)[1] for name, _ in trained.policy.named_parameters()] == ["weight"]
    weight = trained.controller.weight
    assert isinstance(weight, torch.Tensor)
    assert weight.isfinite().all()
    assert weight.any()


@pytest.mark.parametrize("exploration", KINDS)
def test_the_first_natural_step_is_as_long_as_the_trust_region(exploration):
    trained = learner(exploration, updates=2, optimiser="natural", trust_region=1e-3)
    rollout = trained.collection.rollout()
    trained._standardise(rollout)
    trained._weigh(rollout)
    trained.teacher.teach(rollout, 0)
    trained._weigh(rollout)
    divergence = trained._divergence(rollout)
    assert divergence().abs().max() < 1e-12
    trained._step_policy(rollout)
    torch.testing.assert_close(divergence(), torch.full((2,), 1e-3, dtype=torch.float64), rtol=0.3, atol=0)


@pytest.mark.parametrize("exploration", KINDS)
def test_a_learner_of_many_learns_what_it_would_alone(exploration):
    together, alone = learner(exploration), learner(exploration, learners=1, first=1)
    for many, single in zip(together.train(), alone.train(), strict=True):
        for name in ("return", "sigma", "gradient_norm"):
            torch.testing.assert_close(many[name][1:], single[name], rtol=1e-6, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("exploration", KINDS)
def test_a_saved_run_goes_on_as_it_would_have(exploration):
    one, two = learner(exploration), learner(exploration)
    next(one.train())
    file = io.BytesIO()
    torch.save(one.state_dict(), file)
    file.seek(0)
    two.load_state_dict(torch.load(file, weights_only=True))
    for left, right in zip(one.train(), two.train(), strict=True):
        for name, figure in left.items():
            assert torch.equal(figure.nan_to_num(), right[name].nan_to_num()), name


def test_confidence_is_wide_at_first_and_falls_where_the_critic_has_learned():
    figures = list(learner("confidence", updates=5, std=0.7, final_std=0.05).train())
    sigma = torch.stack([figure["sigma"] for figure in figures])
    half = 5.0  # N m, of the actuator's range
    torch.testing.assert_close(sigma[0], torch.full((2,), 0.7 * half, dtype=torch.float64))
    assert (sigma[-1] < 0.9 * sigma[0]).all()
    assert (sigma[-1] >= 0.05 * half).all()


def test_gibbs_grows_sharper():
    trained = learner("gibbs", updates=2, inverse_temperature=2.0, final_inverse_temperature=50.0)
    list(trained.train())
    assert isinstance(trained.policy, GibbsPolicy)
    assert trained.policy.head.inverse_temperature == 50.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"exploration": "gibbs", "estimator": "all-action"},
            "averages over a normal policy, not over gibbs",
        ),
        ({"exploration": "confidence", "critic": "neural"}, "asks the variance or the values of critic 'gp'"),
        ({"inverse_temperature": 0.0}, "inverse_temperature must be positive"),
    ],
)
def test_what_does_not_go_together_is_refused(options, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        PolicyGradientConfig(**options)


def test_a_graph_of_states_and_actions_follows_a_policy_that_asks_the_critic_on_it(monkeypatch):
    monkeypatch.setattr(kernels_by_name, "LOOKAHEAD_OF_ACTIONS", 2)
    numbers = {"kernel": "successor-actions", "targets": "differences", "visited": 20, "rollout_steps": 6}
    trained = learner("gibbs", updates=1, **numbers)  # 40 steps, hence four updates
    for figures in trained.train():
        assert figures["gradient_norm"].isfinite().all()
    (graph,) = graphs(trained.critic)
    assert int(graph.size) == 20  # the newest of 24 since it was cleared
