"""Rehearsed policies against closed forms and the Riccati equation."""

import torch

from torch_gprl.critics.rehearsal import SmoothPolicy, Walks, rehearse

DISCOUNT, PUSH, EFFORT = 0.9, 0.5, 0.1


def step(states, actions):
    """A point on the line that moves by half of the action and is paid −s² − 0.1 a²; there is no end."""
    reward = -(states.square() + EFFORT * actions.square()).sum(-1)
    return states + PUSH * actions, reward, torch.zeros_like(reward)


def nothing(states):
    return torch.zeros_like(states[..., 0])


def line(learners=2, count=25):
    return torch.linspace(-1.5, 1.5, count, dtype=torch.float64).reshape(1, -1, 1).repeat(learners, 1, 1)


def policy(learners=2):
    loc = torch.zeros(learners, 1, 1, dtype=torch.float64)
    return SmoothPolicy(line(learners), loc, loc + 0.9)


def walks(steps=20):
    return Walks(step, nothing, line(count=7) / 3, steps, DISCOUNT)


def riccati_cost():
    """Of the optimal policy, whose value is −cost · s²."""
    cost = 1.0
    for _ in range(200):
        gain = DISCOUNT * cost * PUSH / (EFFORT + DISCOUNT * cost * PUSH**2)
        cost = 1 + EFFORT * gain**2 + DISCOUNT * cost * (1 - PUSH * gain) ** 2
    return cost


def test_actions_given_at_its_states_are_taken_there_and_kept_in_bounds():
    smooth = policy().learn(2 * torch.sin(line()))
    torch.testing.assert_close(smooth(line()), (2 * torch.sin(line())).clamp(-1, 1), rtol=0, atol=0.06)


def test_a_restored_policy_is_the_same():
    smooth = policy().learn(torch.sin(line()))
    restored = SmoothPolicy.restored(smooth.state_dict())
    assert torch.equal(restored(line(count=6)), smooth(line(count=6)))


def test_walks_earn_a_geometric_sum_until_the_end_and_the_value_of_where_they_get_to():
    chance, count = 0.2, 12

    def constant(states, actions):
        reward = torch.ones_like(states[..., 0])
        return states, reward, chance * reward

    paid = Walks(constant, lambda states: 7 + nothing(states), line(), count, DISCOUNT)
    left = (DISCOUNT * (1 - chance)) ** count
    expected = (1 - left) / (1 - DISCOUNT * (1 - chance)) + 7 * left
    torch.testing.assert_close(paid.earned(lambda states: states), torch.full((2,), expected).double())


def test_each_learner_begins_with_the_actions_that_earn_most():
    towards, away = -line().clamp(-1, 1), line().clamp(-1, 1)
    first, second = torch.cat([towards[:1], away[1:]]), torch.cat([away[:1], towards[1:]])
    chosen = rehearse(walks(), policy(), [first, second], ascents=0)
    assert torch.equal(chosen.weights, policy().learn(towards).weights)


def test_ascents_from_doing_nothing_come_near_the_riccati_solution():
    rehearsed = rehearse(walks(), policy(), [torch.zeros_like(line())], ascents=60)
    best = -riccati_cost() * walks().start.square().mean((1, 2))
    assert (walks().earned(rehearsed) > 1.05 * best).all()  # at most 5 % more cost than the optimum
    assert (walks().earned(policy().learn(torch.zeros_like(line()))) < 2 * best).all()


def test_saturated_actions_come_back():
    rehearsed = rehearse(walks(steps=4), policy(), [torch.full_like(line(), 1.2)], ascents=60)
    ahead = torch.full((2, 1, 1), 0.5, dtype=torch.float64)
    assert (rehearsed(ahead) < -0.3).all()


def test_learners_take_policies_of_one_or_the_other():
    loc = torch.zeros(2, 1, 1, dtype=torch.float64)
    few = SmoothPolicy(line(count=5), loc, loc + 0.9).learn(line(count=5))
    many = policy().learn(-line())
    mixed = few.where(torch.tensor([True, False]), many)
    torch.testing.assert_close(mixed(line(count=9))[0], few(line(count=9))[0])
    torch.testing.assert_close(mixed(line(count=9))[1], many(line(count=9))[1])


def test_a_straight_policy_leads_on_beyond_its_states():
    ahead = policy().learn(0.3 * line())(2 * line()[:, :1])  # where the bumps are over
    assert ((ahead > -1) & (ahead < -0.4)).all()


def test_walks_tell_where_they_are_halfway():
    def count(states, actions):
        end = (states >= 7).double().squeeze(-1)
        return states + 1, states.squeeze(-1), end

    start = torch.tensor([0.0, 6.0], dtype=torch.float64).reshape(1, 2, 1)
    outcome = Walks(count, nothing, start, 6, DISCOUNT).walk(lambda states: states)
    assert outcome.halfway.flatten().tolist() == [3.0, 6.0]  # the second is over by then
    assert outcome.lasting.flatten().tolist() == [1.0, 0.0]
