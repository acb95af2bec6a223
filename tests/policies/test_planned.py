"""Exploring on a plan: each way strays from the plan's best action as it says, and learners stay apart."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.critics import PlannedValue
from torch_gprl.critics.look_ahead import continued
from torch_gprl.learners import DynamicProgramming, DynamicProgrammingConfig
from torch_gprl.policies import PlannedBehaviour, PlannedPolicy

SMALL = DynamicProgrammingConfig(
    total_frames=75,
    model_budget=30,
    support=30,
    imagined=20,
    sweeps=3,
    backup_actions=5,
    acting_actions=9,
    novelty_lengthscale=0.5,
    rehearsal=0,
    look_ahead=0,
    variations=8,
)
LOW, HIGH = torch.tensor([-5.0], dtype=torch.float64), torch.tensor([5.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def planner() -> DynamicProgramming:
    learner = DynamicProgramming(envs.make("pendulum-swingup", learners=2, num_envs=1, seed=0), SMALL)
    for _ in learner.train():
        pass
    return learner


def policy_of(planner: DynamicProgramming, learners=(0, 1), **numbers) -> PlannedPolicy:
    return PlannedPolicy(planner.critic, LOW, HIGH, PlannedBehaviour(**numbers), 0, learners)


def states_of(angles: torch.Tensor) -> torch.Tensor:
    one = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1)
    return one.double().expand(2, -1, -1)


def act(policy: PlannedPolicy, states: torch.Tensor) -> torch.Tensor:
    return policy(TensorDict({"observation": states}, states.shape[:2])).get("action")


def test_without_noise_each_way_takes_the_best_action_of_its_plan(planner):
    states = states_of(torch.linspace(2.0, 4.0, 7))
    for scheme, hopeful in (("optimism", True), ("gaussian", False)):
        best = 5 * planner.critic.best_action(states, explore=hopeful)
        torch.testing.assert_close(act(policy_of(planner, exploration=scheme, std=0.0), states), best)


def ahead_of(planner: DynamicProgramming, steps: int) -> PlannedValue:
    """The planner's plan, with a look ahead of so many steps."""
    value = copy.copy(planner.critic)
    value.planning = dataclasses.replace(value.planning, look_ahead=steps)
    return value


def test_looking_ahead_takes_the_first_action_of_a_course_and_goes_on_with_the_rest(planner):
    value, states = ahead_of(planner, 6), states_of(torch.linspace(2.0, 4.0, 7))
    policy = PlannedPolicy(value, LOW, HIGH, PlannedBehaviour(), 0, (0, 1))
    course = value.course(states)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = policy(TensorDict({"observation": states}, states.shape[:2]))
        torch.testing.assert_close(seen["action"], 5 * course[:, :, 0])
        torch.testing.assert_close(seen["course"], continued(course))
        again = policy(TensorDict({"observation": states, "course": seen["course"]}, states.shape[:2]))
    torch.testing.assert_close(again["action"], 5 * value.course(states, continued(course))[:, :, 0])


def test_environments_hand_the_course_on_to_the_next_step(planner):
    policy = PlannedPolicy(ahead_of(planner, 4), LOW, HIGH, PlannedBehaviour(), 0, (0, 1))
    env = envs.make("pendulum-swingup", learners=2, num_envs=1, seed=0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = policy(env.reset())
        course = seen["course"].clone()
        _, state = env.step_and_maybe_reset(seen)
    assert torch.equal(state["course"], course)


def test_when_exploring_nobody_looks_ahead(planner):
    value, states = ahead_of(planner, 6), states_of(torch.linspace(2.0, 4.0, 7))
    policy = PlannedPolicy(value, LOW, HIGH, PlannedBehaviour(std=0.0), 0, (0, 1))
    seen = policy(TensorDict({"observation": states}, states.shape[:2]))
    assert "course" not in seen
    torch.testing.assert_close(seen["action"], 5 * value.best_action(states, explore=True))


def test_when_exploiting_all_ways_are_one(planner):
    states = states_of(torch.linspace(0.0, 6.0, 5))
    best = 5 * planner.critic.best_action(states, explore=False)
    for scheme in ("optimism", "gaussian", "confidence", "gibbs"):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            torch.testing.assert_close(act(policy_of(planner, exploration=scheme), states), best)


def test_confidence_noise_is_widest_where_nothing_was_seen(planner):
    states = torch.cat([planner.experience.all()["observation"][:, :5], states_of(torch.zeros(1))], 1)
    policy = policy_of(planner, exploration="confidence", noise_scale=0.49, least_std=0.02)
    std = policy.std_at(states, torch.zeros(2, 6, 1, dtype=torch.float64)).squeeze(-1)
    assert (std[:, -1:] > std[:, :-1]).all()  # upright, where the pendulum has not been
    assert std[:, -1].tolist() == pytest.approx([0.7, 0.7], rel=0.1)
    assert (std >= 0.02).all()


def test_gibbs_actions_follow_their_density(planner):
    policy = policy_of(planner, exploration="gibbs", std=0.0, inverse_temperature=2.0, gibbs_width=1.0)
    states = states_of(torch.full((2000,), 3.0))
    shares = policy.gibbs_shares(states[:, :1])[:, 0]
    candidates = 5 * planner.critic.acting_actions[:, 0]
    actions = act(policy, states).squeeze(-1)
    for learner in range(2):
        counts = np.array([(actions[learner] == one).sum().item() for one in candidates])
        assert counts.sum() == 2000
        assert chisquare(counts, 2000 * shares[learner].numpy()).pvalue > 1e-3


def test_gibbs_density_is_that_of_the_hopeful_value_near_the_best_action(planner):
    policy = policy_of(planner, exploration="gibbs", inverse_temperature=7.0, gibbs_width=0.4)
    states = states_of(torch.tensor([2.5, 3.0]))
    value = planner.critic.candidate_values(states, explore=True).numpy()
    best = planner.critic.best_action(states, explore=False).numpy()
    candidates = planner.critic.acting_actions.numpy()[:, 0]
    low, high = value.min(-1, keepdims=True), value.max(-1, keepdims=True)
    expected = np.exp(7 * (value - low) / (high - low) - 0.5 * ((candidates - best) / 0.4) ** 2)
    expected /= expected.sum(-1, keepdims=True)
    np.testing.assert_allclose(policy.gibbs_shares(states).numpy(), expected, rtol=1e-8)


def test_the_temperature_falls_and_the_noise_too(planner):
    numbers = {"inverse_temperature": 2.0, "final_inverse_temperature": 200.0, "std": 0.5, "final_std": 0.1}
    policy = policy_of(planner, exploration="gibbs", **numbers)
    states = states_of(torch.tensor([3.0]))
    action = torch.zeros(2, 1, 1, dtype=torch.float64)
    before, wide = policy.gibbs_shares(states), policy.std_at(states, action)
    policy.anneal(1.0)
    assert (policy.gibbs_shares(states).amax(-1) > before.amax(-1)).all()
    assert (wide.unique().item(), policy.std_at(states, action).unique().item()) == pytest.approx((0.5, 0.1))


def test_who_has_settled_performs_and_others_explore():
    env = envs.make("pendulum-swingup", learners=2, num_envs=1, seed=0)
    learner = DynamicProgramming(env, dataclasses.replace(SMALL, rehearsal=2, ascents=0))
    for _ in learner.train():
        pass
    state = learner.state_dict()
    state["plan"]["performance"]["settled"] = torch.tensor([True, False]).view(2, 1, 1)
    learner.load_state_dict(state)
    states = states_of(torch.linspace(0.0, 6.0, 5))
    actions = act(policy_of(learner, exploration="optimism", std=0.0), states)
    performed, hopeful = (5 * learner.critic.best_action(states, explore) for explore in (False, True))
    assert not torch.equal(performed, hopeful)
    torch.testing.assert_close(actions, torch.stack([performed[0], hopeful[1]]))


def test_a_learner_explores_alone_as_among_others():
    def actions(learners: int, first: int) -> torch.Tensor:
        env = envs.make("pendulum-swingup", learners=learners, num_envs=1, seed=0, first_learner=first)
        config = dataclasses.replace(SMALL, exploration="gibbs")
        learner = DynamicProgramming(env, config, first_learner=first)
        for _ in learner.train():
            pass
        return learner.experience.all()["action"]

    torch.testing.assert_close(actions(2, 0)[1:], actions(1, 1), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("numbers", "complaint"),
    [
        ({"std": -0.1}, "std must be at least 0"),
        ({"gibbs_width": 0.0}, "width must be positive"),
        ({"least_std": 2.0}, "floor and ceiling"),
    ],
)
def test_what_is_no_behaviour_is_named(numbers, complaint):
    with pytest.raises(ValueError, match=complaint):
        PlannedBehaviour(**numbers)
