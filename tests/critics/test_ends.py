"""Ends of tasks, told from other states, and what they pay."""

import torch

from torch_gprl.critics.ends import MOST_ENDS, Ends
from torch_gprl.kernels import Matern

OTHERS = torch.linspace(-1, 0.5, 16, dtype=torch.float64).reshape(1, -1, 1)


def met(places, surplus, steps=100):
    """Ends of one learner at places on the line, met in the last of its steps."""
    following = torch.zeros(1, steps, 1, dtype=torch.float64)
    terminated, paid = torch.zeros(1, steps, dtype=torch.float64), torch.zeros(1, steps, dtype=torch.float64)
    if len(places):
        following[0, -len(places) :, 0] = torch.as_tensor(places, dtype=torch.float64)
        terminated[0, -len(places) :] = 1
        paid[0, -len(places) :] = torch.as_tensor(surplus, dtype=torch.float64)
    return following, terminated, paid


def learned(*learners):
    data = (torch.cat(values) for values in zip(*learners, strict=True))
    kernel = Matern(1, smoothness=0.5).double().requires_grad_(False)
    return Ends(kernel, OTHERS.expand(len(learners), -1, -1), *data)


def at(places, learners=1):
    return torch.as_tensor(places, dtype=torch.float64).reshape(1, -1, 1).expand(learners, -1, -1)


def test_each_end_pays_what_was_paid_there_and_other_states_pay_nothing():
    ends = learned(met([-1.5, 1.0], [-30.0, 100.0]))
    end, prize = ends.judge(at([-1.5, 1.0, -0.5, 0.2]))
    torch.testing.assert_close(end, at([1.0, 1.0, 0.0, 0.0]).squeeze(-1), rtol=0, atol=0.01)
    torch.testing.assert_close(prize, at([-30.0, 100.0, 0.0, 0.0]).squeeze(-1), rtol=0, atol=1.0)


def test_half_way_to_an_end_is_half_an_end():
    end, prize = learned(met([1.0], [100.0])).judge(at([0.75]))
    assert abs(end - 0.5) < 0.05
    torch.testing.assert_close(prize, 100 * end)


def test_where_no_task_ended_nothing_looks_like_an_end():
    end, prize = learned(met([], [])).judge(at([-5.0, 0.0, 5.0]))
    assert not end.any()
    assert not prize.any()


def test_a_learner_without_ends_learns_none_from_its_neighbour():
    ends = learned(met([1.0, 1.1, 1.2], [10.0, 10.0, 10.0]), met([], []))
    alone = learned(met([1.0, 1.1, 1.2], [10.0, 10.0, 10.0]))
    end, prize = ends.judge(at([-0.5, 1.1], 2))
    torch.testing.assert_close((end[:1], prize[:1]), alone.judge(at([-0.5, 1.1])))
    assert not end[1].any()
    assert not prize[1].any()


def test_of_very_many_ends_those_kept_lie_everywhere():
    places = torch.cat([torch.full((2 * MOST_ENDS,), 1.0), torch.tensor([2.0, -3.0])])
    ends = learned(met(places, torch.ones_like(places), steps=3 * MOST_ENDS))
    assert ends.scaled.shape[1] <= MOST_ENDS
    assert (ends.judge(at([1.0, 2.0, -3.0]))[0] > 0.95).all()
