"""Courses of actions, tried on a model, against closed forms and the Riccati equation."""

import pytest
import torch

from torch_gprl.critics.look_ahead import FINEST, WIDEST, LookAhead, continued, variations

DISCOUNT, PUSH, EFFORT = 0.9, 0.5, 0.1
STEPS = 12


def step(states, actions):
    """A point on the line that moves by half of the action and is paid −s² − 0.1 a²; there is no end."""
    reward = -(states.square() + EFFORT * actions.square()).sum(-1)
    return states + PUSH * actions, reward, torch.zeros_like(reward)


def ending(states, actions):
    """The same, but one chance in four to end the task."""
    states, reward, end = step(states, actions)
    return states, reward, end + 0.25


def nothing(states):
    return torch.zeros_like(states[..., 0])


def away(states):
    """A bad policy."""
    return states.sign()


def timid(states):
    """A policy that goes home too slowly."""
    return -0.4 * states


def search(step=step, value=nothing, policy=away, steps=STEPS):
    return LookAhead(step, value, policy, DISCOUNT, steps)


def line(learners=2, count=7):
    return torch.linspace(-0.5, 0.5, count, dtype=torch.float64).reshape(1, -1, 1).repeat(learners, 1, 1)


def at_rest(learners=2, count=7):
    return torch.zeros(learners, count, STEPS, 1, dtype=torch.float64)


def optimal_cost():
    """Of the optimal policy, as a factor of the square of the first state."""
    cost = 1.0
    for _ in range(200):
        gain = DISCOUNT * cost * PUSH / (EFFORT + DISCOUNT * cost * PUSH**2)
        cost = 1 + EFFORT * gain**2 + DISCOUNT * cost * (1 - PUSH * gain) ** 2
    return cost


def test_what_resting_earns_is_a_geometric_series_and_the_value_at_its_end():
    def value(states):
        return states.squeeze(-1)

    earned = search(value=value).earned(line(), at_rest().unsqueeze(2)).squeeze(-1)
    position = line().squeeze(-1)
    series = (1 - DISCOUNT**STEPS) / (1 - DISCOUNT)
    torch.testing.assert_close(earned, -series * position.square() + DISCOUNT**STEPS * position)


def test_what_comes_after_an_end_counts_as_little_as_the_end_is_likely():
    earned = search(step=ending).earned(line(), at_rest().unsqueeze(2)).squeeze(-1)
    series = (1 - (0.75 * DISCOUNT) ** STEPS) / (1 - 0.75 * DISCOUNT)
    torch.testing.assert_close(earned, -series * line().squeeze(-1).square())


def test_the_course_of_the_policy_follows_it():
    course = search(policy=timid, steps=3).followed(line())
    left = 1 - 0.4 * PUSH
    torch.testing.assert_close(course, torch.stack([-0.4 * line() * left**t for t in range(3)], 2))


def test_what_is_found_never_earns_less_than_the_course_before_or_the_policy():
    ahead = search()
    course = (
        torch.rand(2, 7, STEPS, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 2 - 1
    )
    known = torch.stack([course, ahead.followed(line())], 2)
    found = ahead.better(line(), course, variations(16, STEPS, 1))
    best = ahead.earned(line(), known).amax(-1, keepdim=True)
    assert (ahead.earned(line(), found.unsqueeze(2)) >= best).all()


def test_without_variations_the_policy_is_followed_where_it_is_better():
    ahead = search(policy=timid)
    found = ahead.better(line(), at_rest(), variations(0, STEPS, 1))
    torch.testing.assert_close(found, ahead.followed(line()))


@pytest.mark.parametrize("chunk", [1, 3, 100])
def test_states_are_looked_at_in_parts(chunk):
    ahead, varied = search(policy=timid), variations(8, STEPS, 1)
    expected = ahead.better(line(), ahead.followed(line()), varied)
    torch.testing.assert_close(ahead.course(line(), None, varied, chunk), expected)
    again = ahead.better(line(), expected, varied)
    torch.testing.assert_close(ahead.course(line(), expected, varied, chunk), again)


def test_looking_ahead_takes_away_most_of_what_a_policy_loses():
    ahead, states, course = search(policy=timid), line(), None
    earned = torch.zeros(2, 7, dtype=torch.float64)
    for steps in range(30):
        course = ahead.course(states, course, variations(48, STEPS, 1), 100)
        states, reward, _ = step(states, course[:, :, 0])
        earned, course = earned + DISCOUNT**steps * reward, continued(course)
    square = line().squeeze(-1).square()
    cost_of_timid = (1 + EFFORT * 0.4**2) / (1 - DISCOUNT * (1 - 0.4 * PUSH) ** 2)
    best, lost = -optimal_cost() * square, (optimal_cost() - cost_of_timid) * square
    assert (earned <= best + 1e-12).all()
    assert (earned >= best + 0.5 * lost - 1e-12).all()


def test_actions_stay_in_bounds():
    found = search().better(line(), at_rest() + 0.9, variations(48, STEPS, 1))
    assert (found.abs() <= 1).all()


def test_variations_are_the_same_each_time_of_both_signs_and_of_all_scales():
    varied = variations(200, STEPS, 2)
    assert varied.shape == (400, STEPS, 2)
    assert torch.equal(varied, variations(200, STEPS, 2))
    torch.testing.assert_close(varied[:200], -varied[200:])
    widths = varied[:200].square().mean((1, 2)).sqrt()
    assert 0.7 * WIDEST < widths[:20].mean() < WIDEST
    assert FINEST < widths[-20:].mean() < 1.4 * FINEST
    scaled = varied[:200] / widths[:, None, None]
    likeness = (scaled[:, 1:] * scaled[:, :-1]).mean()
    assert 0.7 < likeness < 0.9


def test_a_course_goes_on_with_its_next_action():
    course = torch.arange(5.0, dtype=torch.float64).view(1, 1, 5, 1)
    assert continued(course).flatten().tolist() == [1, 2, 3, 4, 4]


def test_a_learner_finds_the_same_alone_as_among_others():
    states, course, varied = line(3), at_rest(3), variations(24, STEPS, 1)
    states = states * torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64).view(3, 1, 1)
    together = search().better(states, course, varied)
    for learner in range(3):
        alone = search().better(states[learner : learner + 1], course[:1], varied)
        torch.testing.assert_close(alone[0], together[learner])
