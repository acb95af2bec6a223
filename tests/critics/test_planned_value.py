"""Planned values against problems whose values are known in closed form."""

import pytest
import torch

from torch_gprl.critics import PlannedValue, Planning, TransitionModel, Transitions
from torch_gprl.critics.planned_value import IMAGINED_STEPS

BOUND = torch.ones(1, dtype=torch.float64)


def walk(learners=2, steps=150, end=None, seed=0):
    """A point on the line that moves by a tenth of the action and is paid −s² − 0.1 a²."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.rand(learners, steps, 1, generator=generator, dtype=torch.float64)
    state = -2 + state * (4 if end is None else 2 + end)  # nobody steps on from beyond the end
    action = torch.rand(learners, steps, 1, generator=generator, dtype=torch.float64) * 2 - 1
    following = state + 0.5 * action
    reward = -(state.square() + 0.1 * action.square()).squeeze(-1)
    terminated = torch.zeros_like(reward) if end is None else (following.squeeze(-1) > end).double()
    return Transitions(state, action, reward, following, terminated)


def planned(data, **numbers):
    """A plan; nothing is rehearsed unless told."""
    numbers = {"rehearsal": 0} | numbers
    model = TransitionModel(len(data.reward), 1, 1, budget=100)
    model.solve(data, fit=True)
    value = PlannedValue(model, -BOUND, BOUND, Planning(**numbers), acting_actions=41)
    columns = 1 + IMAGINED_STEPS
    uniform = torch.rand(2, 100, columns, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    value.plan(data, uniform[: len(data.reward)])
    return value


def grid(count=9):
    return torch.linspace(-1.5, 1.5, count, dtype=torch.float64).reshape(1, -1, 1).expand(2, -1, -1)


def by_tables(discount, points=801):
    """Value iteration for `walk` on a fine grid: states [points] and values."""
    states = torch.linspace(-2.5, 2.5, points, dtype=torch.float64)
    actions = torch.linspace(-1, 1, 41, dtype=torch.float64)
    following = (states[:, None] + 0.5 * actions).clamp(-2.5, 2.5)
    left = ((following + 2.5) / 5 * (points - 1)).floor().clamp(0, points - 2)
    share = (following + 2.5) / 5 * (points - 1) - left
    left = left.long()
    values = torch.zeros_like(states)
    for _ in range(300):
        beyond = values[left] * (1 - share) + values[left + 1] * share
        values = (-states[:, None].square() - 0.1 * actions.square() + discount * beyond).amax(1)
    return states, values


def test_the_model_predicts_steps_of_a_linear_system():
    data = walk()
    model = TransitionModel(2, 1, 1, budget=100)
    model.solve(data, fit=True)
    action = torch.full_like(grid(), 0.4)
    step = model.predict(grid(), action)
    torch.testing.assert_close(step.observation, grid() + 0.2, rtol=0, atol=1e-3)
    expected = -(grid().square() + 0.1 * action.square()).squeeze(-1)
    torch.testing.assert_close(step.reward, expected, rtol=0, atol=1e-2)
    assert (step.doubt < 0.05).all()


def test_doubt_grows_away_from_the_data():
    near, far = torch.zeros(2, 1, 1, dtype=torch.float64), torch.full((2, 1, 1), 60.0, dtype=torch.float64)
    model = TransitionModel(2, 1, 1, budget=100)
    model.solve(walk(), fit=True)
    assert (model.predict(far, near).doubt > model.predict(near, near).doubt + 0.1).all()


def test_values_are_those_of_value_iteration_on_a_fine_table():
    value = planned(walk(), discount=0.9, tremble=0.01, hold=1)
    states, values = by_tables(0.9)
    best = value.best_action(grid(), explore=False)
    found = value.action_values(grid(), best, explore=False)
    index = ((grid().squeeze(-1) + 2.5) / 5 * (len(states) - 1)).round().long()
    torch.testing.assert_close(found, values[index], rtol=0, atol=0.1 * float(values[index].std()))


def test_the_best_action_leads_to_the_middle():
    action = planned(walk(), discount=0.9).best_action(grid(), explore=False)
    assert (action[:, :3] > 0.5).all()
    assert (action[:, -3:] < -0.5).all()
    assert (action[:, 4].abs() < 0.2).all()


def test_an_end_is_worth_nothing_and_attracts_where_every_step_costs():
    value = planned(walk(end=1.0), discount=0.9)
    near = torch.full((2, 1, 1), 0.8, dtype=torch.float64)
    assert (value.best_action(near, explore=False) > 0.3).all()  # one step of it ends all costs
    over = torch.full_like(near, 1.0)
    torch.testing.assert_close(
        value.action_values(near, over, explore=False),
        torch.full((2, 1), -(0.64 + 0.1), dtype=torch.float64),
        rtol=0,
        atol=0.1,
    )


def test_a_prize_that_was_paid_once_in_hundreds_of_steps_is_not_smeared_over_the_way():
    data = walk(learners=1, steps=400)
    data = data._replace(reward=-0.1 * data.action.square().squeeze(-1))
    data.observation[:, 250], data.action[:, 250], data.following[:, 250] = 2.3, 1.0, 2.8
    data.terminated[:, 250], data.reward[:, 250] = 1.0, 100.0
    value = planned(data)
    goal, action = torch.full((1, 1, 1), 2.3, dtype=torch.float64), torch.ones(1, 1, 1, dtype=torch.float64)
    torch.testing.assert_close(value.reward(goal, action).item(), 100.0, rtol=0, atol=5.0)
    away = grid()[:1]
    torch.testing.assert_close(
        value.reward(away, torch.zeros_like(away)), torch.zeros_like(away[..., 0]), rtol=0, atol=0.1
    )
    assert (value.best_action(goal, explore=False) > 0.5).all()


def test_a_trembling_hand_keeps_away_from_an_edge():
    """Every step is paid 1 until the end beyond 1: of the actions that stay, all are worth the same."""
    data = walk(end=1.0)
    data = data._replace(reward=torch.ones_like(data.reward))
    near = torch.full((2, 1, 1), 0.8, dtype=torch.float64)  # actions above 0.4 end the task
    steady, careful = (planned(data, tremble=tremble).best_action(near, False) for tremble in (0.01, 0.25))
    assert (careful < -0.3).all()
    assert (careful <= steady).all()


def test_a_held_action_is_followed_to_the_end_that_it_leads_to():
    """Every step is paid 1 until the end beyond 1; who chooses anew in every step can turn back before it."""
    data = walk(end=1.0)
    data = data._replace(reward=torch.ones_like(data.reward))
    near, towards = torch.full((2, 1, 1), 0.5, dtype=torch.float64), torch.ones(2, 1, 1, dtype=torch.float64)
    held, free = (
        planned(data, discount=0.9, hold=hold, tremble=0.01).action_values(near, 0.7 * towards, explore=False)
        for hold in (3, 1)
    )
    torch.testing.assert_close(
        held, torch.full_like(held, 1 + 0.9), rtol=0, atol=0.5
    )  # ends at 0.5 + 2 · 0.35
    assert (free > 4).all()  # of at most 10


def test_values_keep_to_the_attainable_range():
    data = walk()
    value = planned(data, discount=0.9)
    far = torch.linspace(-30, 30, 13, dtype=torch.float64).reshape(1, -1, 1).expand(2, -1, -1)
    found = value.action_values(far, torch.zeros_like(far), explore=False)
    assert (found <= data.reward.max() + 0.9 * data.reward.amax(1, keepdim=True) / 0.1 + 1e-9).all()
    assert (found >= data.reward.amin(1, keepdim=True) / 0.1 - 1e-9).all()


def test_exploring_hopes_for_more_than_exploiting_and_most_where_nobody_was():
    value = planned(walk(), discount=0.9)
    still = torch.zeros(2, 1, 1, dtype=torch.float64)
    hope = [
        value.action_values(still + place, still, explore=True)
        - value.action_values(still + place, still, explore=False)
        for place in (0.0, 4.0)
    ]
    assert (hope[0] >= -1e-9).all()
    assert (hope[1] > hope[0]).all()


def test_the_unknown_attracts_even_before_any_step_was_paid():
    data = walk()
    value = planned(data._replace(reward=torch.zeros_like(data.reward)))
    right = torch.full((2, 1, 1), 2.3, dtype=torch.float64)  # visited up to 2.5
    assert (value.best_action(right, explore=True) > 0.5).all()


def test_a_prize_that_an_end_pays_is_hoped_for_once():
    data = walk(end=1.0)
    value = planned(data._replace(reward=100 * data.terminated), optimism=1.0)
    far = torch.full((2, 1, 1), -9.0, dtype=torch.float64)
    hope = value.action_values(far, torch.zeros_like(far), explore=True)
    assert ((hope > 80) & (hope <= 100 + 1e-9)).all()  # the prize, and no more: steps pay alike


@pytest.mark.parametrize("learner", [0, 1])
def test_learners_plan_apart(learner):
    data = walk()
    alone = Transitions(*(values[learner : learner + 1] for values in data))
    together = planned(data).best_action(grid(), explore=False)[learner]
    model = TransitionModel(1, 1, 1, budget=100)
    model.solve(alone, fit=True)
    value = PlannedValue(model, -BOUND, BOUND, Planning(rehearsal=0), acting_actions=41)
    uniform = torch.rand(2, 100, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    value.plan(alone, uniform[learner : learner + 1])
    own = value.best_action(grid()[:1], explore=False)[0]
    torch.testing.assert_close(own, together, rtol=0, atol=0.06)  # ties between neighbours may fall apart


@pytest.mark.parametrize(("rehearsal", "kept"), [(8, True), (0, False)])
def test_a_bad_plan_does_not_change_what_was_rehearsed_well(rehearsal, kept):
    data = walk()
    value = planned(data, discount=0.9, sweeps=1, hold=1, rehearsal=rehearsal)
    before = value.best_action(grid(), explore=False)
    state = value.state_dict()
    state["support"]["weights"] = -5 * state["support"]["weights"]  # the next plan begins with the opposite
    value.load_state_dict(state, data)
    value.plan(data, torch.zeros(2, 0, 1 + IMAGINED_STEPS, dtype=torch.float64))
    after = value.best_action(grid(), explore=False)
    assert bool(((after - before).abs() < 0.5).all()) == kept


def test_a_plan_that_earns_more_than_what_was_rehearsed_takes_over():
    data = walk()
    value = planned(data, discount=0.9, rehearsal=8)
    before = value.best_action(grid(), explore=False)
    state = value.state_dict()
    state["performance"]["policy"]["weights"] = -state["performance"]["policy"]["weights"]
    value.load_state_dict(state, data)
    value.plan(data, torch.zeros(2, 0, 1 + IMAGINED_STEPS, dtype=torch.float64))
    torch.testing.assert_close(value.best_action(grid(), explore=False), before, rtol=0, atol=0.3)


@pytest.mark.parametrize("smooth", [True, False])
def test_who_performs_the_plan_rehearses_only_with_a_model_that_was_fitted_afresh(smooth):
    data = walk()
    value = planned(data, discount=0.9, rehearsal=4)
    state = value.state_dict()
    state["performance"]["smooth"] = torch.full((2, 1, 1), smooth)
    bad = -state["performance"]["policy"]["weights"]  # a rehearsal finds better
    state["performance"]["policy"]["weights"] = bad
    value.load_state_dict(state, data)
    nothing = torch.zeros(2, 0, 1 + IMAGINED_STEPS, dtype=torch.float64)
    for fresh, rehearsed in ((False, smooth), (True, True)):
        value.plan(data, nothing, fresh=fresh)
        assert torch.equal(value.state_dict()["performance"]["policy"]["weights"], bad) != rehearsed
