"""What is performed, and who has settled, where both can be told beforehand."""

import torch

from torch_gprl.critics.performance import Imagination, Performance, prepare
from torch_gprl.critics.rehearsal import SmoothPolicy, Walks
from torch_gprl.critics.transition_model import Transitions

DISCOUNT, LEARNERS, STEPS, COUNT = 0.9, 3, 10, 120
BEST = 1 / (1 - DISCOUNT)  # value of rewards of 1 for ever
LOW, HIGH = torch.zeros(LEARNERS, dtype=torch.float64), torch.full((LEARNERS,), BEST, dtype=torch.float64)


def line(count: int = 9) -> torch.Tensor:
    return torch.linspace(-1, 1, count, dtype=torch.float64).reshape(1, -1, 1).repeat(LEARNERS, 1, 1)


def policy(gain: float = 0.0) -> SmoothPolicy:
    loc = torch.zeros(LEARNERS, 1, 1, dtype=torch.float64)
    return SmoothPolicy(line(), loc, loc + 0.6).learn(gain * line())


def step(states: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A point on the line that moves by half of the action, is paid 1 − s², and is lost beyond ±2."""
    following = states + 0.5 * actions
    end = (following.abs() > 2).double().squeeze(-1)
    return following, 1 - following.square().squeeze(-1), end


def experience(paid: float, ends: int, first_end: bool = True) -> Transitions:
    """Visited states, what each step was paid, an end at first, and so many at last."""
    steps = line(COUNT)
    ended = torch.zeros_like(steps[..., 0])
    ended[:, COUNT - ends :] = 1
    ended[:, 0] = first_end
    return Transitions(steps, torch.zeros_like(steps), torch.full_like(ended, paid), steps, ended)


def imagine(planned_gain: float, hoped: float = 10.0, data: Transitions | None = None) -> Imagination:
    """The plan's actions are so many times the state; exploring hopes for the same everywhere."""

    def walks(start: torch.Tensor, steps: int) -> Walks:
        return Walks(step, lambda states: torch.full_like(states[..., 0], BEST), start, steps, DISCOUNT)

    def plan(states: torch.Tensor) -> torch.Tensor:
        return (planned_gain * states).clamp(-1, 1)

    def hope(states: torch.Tensor) -> torch.Tensor:
        return torch.full_like(states[..., 0], hoped)

    seen = experience(paid=0, ends=1) if data is None else data
    return Imagination(walks, plan, plan, hope, seen, LOW, HIGH, DISCOUNT)


def performing(gain: float, smooth: bool, settled: bool, since: int = COUNT) -> Performance:
    mask = torch.ones(LEARNERS, 1, 1, dtype=torch.bool)
    kept = torch.full((LEARNERS, 1, 1), float(since), dtype=torch.float64)
    return Performance(policy(gain), mask & smooth, mask & settled, line(8), kept)


def test_the_better_of_plan_and_policy_is_performed():
    for planned, held, smooth in ((1.0, -1.8, True), (-1.8, 0.5, False)):
        prepared = prepare(imagine(planned), policy(), performing(held, not smooth, settled=False), STEPS, 0)
        assert (prepared.smooth == smooth).all()
        towards = prepared.action(line(), imagine(planned).planned)
        assert (towards * line() <= 0).all()  # back to the middle, be it by the one or the other


def test_a_policy_that_earns_no_more_does_not_replace_the_one_in_hand():
    held = performing(-1.8, smooth=True, settled=False)
    prepared = prepare(imagine(1.0), policy(), held, STEPS, ascents=0)  # begins with the same actions
    torch.testing.assert_close(prepared.policy(line(30)), held.policy(line(30)), rtol=0, atol=0)


def test_only_who_has_settled_keeps_a_policy_that_is_as_good_as_the_plan():
    for settled in (True, False):
        held = performing(-1.8, smooth=True, settled=settled)
        prepared = prepare(imagine(-1.9), policy(), held, STEPS, ascents=0)
        assert (prepared.smooth == settled).all()


def test_a_settled_policy_that_lasts_in_reality_is_kept_whatever_is_imagined():
    # in imagination the held policy leaves the line, and the plan goes to the best place at once
    for ends, since, paid, settled, first_end, kept in (
        (1, 1, 1.0, True, True, True),  # 20 steps, and 80 for an end
        (2, 1, 1.0, True, True, False),
        (1, COUNT - 99, 1.0, True, True, False),
        (0, COUNT - 2 * STEPS, 1.0, True, True, True),
        (0, COUNT - 2 * STEPS + 1, 1.0, True, True, False),  # it was another policy that lasted
        (0, 1, 0.98, True, True, False),  # there is more to earn
        (0, 1, 1.0, False, True, False),
        (0, 1, 1.0, True, False, False),  # nobody has ever been lost
    ):
        held = performing(3.0, smooth=True, settled=settled, since=since)
        imagination = imagine(-1.9, data=experience(paid, ends, first_end))
        prepared = prepare(imagination, policy(), held, STEPS, ascents=0)
        assert torch.equal(prepared.action(line(5), torch.zeros_like), held.policy(line(5))) == kept


def test_a_policy_is_kept_since_it_was_settled_on():
    held = performing(-1.8, smooth=True, settled=True, since=3)
    assert (prepare(imagine(-1.9), policy(), held, STEPS, ascents=0).since == 3).all()
    assert (prepare(imagine(-1.9), policy(), None, STEPS, ascents=0).since == COUNT).all()


def test_who_earns_what_is_hoped_for_has_settled():
    for hoped, settled in ((BEST - 0.5, True), (BEST + 0.5, False)):
        prepared = prepare(imagine(-1.9, hoped), policy(), None, STEPS, ascents=0)
        assert (prepared.settled == settled).all()


def test_who_is_lost_in_imagination_has_not_settled():
    prepared = prepare(imagine(2.0, hoped=-1e9), policy(), None, STEPS, ascents=0)
    assert not prepared.settled.any()


def test_each_learner_takes_its_own_of_two_performances():
    ours, theirs = performing(-0.7, smooth=True, settled=True), performing(0.4, smooth=False, settled=False)
    chosen = torch.tensor([True, False, True]).view(LEARNERS, 1, 1)
    mixed = ours.where(chosen, theirs)
    for kept in (mixed.smooth, mixed.settled):
        assert torch.equal(kept, chosen)
    expected = torch.where(chosen, ours.policy(line()), theirs.policy(line()))
    torch.testing.assert_close(mixed.policy(line()), expected)


def test_a_kept_performance_is_the_same():
    held = performing(-0.7, smooth=True, settled=True)
    kept = Performance.restored(held.state_dict())
    assert torch.equal(kept.action(line(5), torch.zeros_like), held.action(line(5), torch.zeros_like))
    assert torch.equal(kept.settled, held.settled)
