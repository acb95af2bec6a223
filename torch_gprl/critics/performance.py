"""What a learner performs when nothing is explored, and when there is nothing left to explore for.

Two things stand by: the plan's best actions, and a smooth policy that was rehearsed (`rehearsal`). The plan
errs where many actions are worth nearly the same, and is another one after every plan; but it switches more
sharply. Both walk through the model, for longer than the policy was rehearsed, and the policy is performed if
it earns clearly more. Another policy must earn more on the present model than the one in hand, or that one
stays; and who has settled on a policy leaves it for a clear gain alone: who holds a pole keeps what holds it.

Half of the walks begin where earlier ones were halfway: what fails later than a rehearsal lasts shows in none
that begins in visited states.

A rehearsal costs several times as much as a plan: who performs the plan rehearses anew only when the model
was fitted afresh.

A learner has settled if what it performs earns all that the exploring plan Q⁺ hopes for, on the walks that
last:

    J(s₀) ≥ max_a Q⁺(s₀, a)

Then nothing is gained by exploring. A settled learner performs while it learns, so that its experience
gathers where it lives, and the model gets right there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.critics.rehearsal import Outcome, SmoothPolicy, Walks, rehearse, spread

WALKS, TRIALS = 16, 8  # imagined walks: to rehearse, and to compare
LONGER = 2  # times as many steps as a rehearsal: a comparison
LEAST_LASTING = 0.1  # chance of going on to the end of a walk, of a learner that has settled
Map = Callable[[Float[Tensor, "L N S"]], Tensor]


@dataclass(frozen=True)
class Imagination:
    """What a learner can imagine.

    Args:
        walks: states to begin from and a number of steps, to walks through the model.
        planned: states to the best actions of the plan.
        roughly: the same, out of fewer actions.
        hoped: states to what the exploring plan hopes for there [L, N].
        visited: [L, N, S] states of the experience, in time order.
        margin: [L] difference of values that does not count.
    """

    walks: Callable[[Tensor, int], Walks]
    planned: Map
    roughly: Map
    hoped: Map
    visited: Tensor
    margin: Tensor


class Performance:
    """What learners perform.

    Args:
        policy: the smooth one in hand.
        smooth: [L, 1, 1] whether it is what is performed, else the plan.
        settled: [L, 1, 1] whether there is nothing left to explore for.
        reached: [L, N, S] where performing has led in imagination.
    """

    def __init__(self, policy: SmoothPolicy, smooth: Tensor, settled: Tensor, reached: Tensor) -> None:
        self.policy, self.smooth, self.settled, self.reached = policy, smooth, settled, reached
        self._all_smooth = bool(smooth.all())  # then nobody asks the plan
        self.any_smooth = bool(smooth.any())
        self.any_settled, self.all_settled = bool(settled.any()), bool(settled.all())

    def action(self, observation: Float[Tensor, "L N S"], planned: Map) -> Float[Tensor, "L N A"]:
        """What is performed, in halves of the actuator's range."""
        if self._all_smooth:
            return self.policy(observation)
        return torch.where(self.smooth, self.policy(observation), planned(observation))

    def where(self, chosen: Bool[Tensor, "L 1 1"], other: "Performance") -> "Performance":
        """This one for the chosen learners, the other for the rest."""
        policy = self.policy.where(chosen.flatten(), other.policy)
        pairs = ((self.smooth, other.smooth), (self.settled, other.settled), (self.reached, other.reached))
        return Performance(policy, *(torch.where(chosen, ours, theirs) for ours, theirs in pairs))

    def state_dict(self) -> dict[str, Any]:
        """All that it was made of."""
        tensors = {"smooth": self.smooth, "settled": self.settled, "reached": self.reached}
        return {"policy": self.policy.state_dict()} | tensors

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "Performance":
        """What `state_dict` was taken of."""
        tensors = (state[name] for name in ("smooth", "settled", "reached"))
        return cls(SmoothPolicy.restored(state["policy"]), *tensors)


def prepare(
    imagination: Imagination, policy: SmoothPolicy, last: Performance | None, steps: int, ascents: int
) -> Performance:
    """Rehearse a policy and choose what is performed.

    Args:
        imagination: what can be imagined now.
        policy: receives what is rehearsed.
        last: what was performed so far.
        steps: of a walk in rehearsal.
        ascents: gradient steps of the rehearsal.
    """
    planned = imagination.planned(policy.states)
    choices = [planned] if last is None else [last.policy(policy.states), planned]
    rehearse(imagination.walks(_starts(imagination, last, WALKS), steps), policy, choices, ascents)
    trial = imagination.walks(_starts(imagination, last, TRIALS), LONGER * steps)
    outcome = trial.walk(policy)
    held = torch.zeros_like(imagination.margin, dtype=torch.bool)  # who has settled on a policy
    if last is not None:
        held = (last.smooth & last.settled).flatten()
        before = trial.walk(last.policy)
        stays = before.earned.mean(1) + held * imagination.margin >= outcome.earned.mean(1)
        policy, outcome = last.policy.where(stays, policy), before.where(stays, outcome)
    by_plan = trial.walk(imagination.roughly)
    gain = outcome.earned.mean(1) - by_plan.earned.mean(1)
    smooth = gain > torch.where(held, -imagination.margin, imagination.margin)
    outcome = outcome.where(smooth, by_plan)
    settled = _settled(imagination, trial.start, outcome)
    return Performance(policy, smooth.view(-1, 1, 1), settled.view(-1, 1, 1), outcome.halfway)


def _starts(imagination: Imagination, last: Performance | None, count: int) -> Float[Tensor, "L M S"]:
    """So many states to begin walks from."""
    if last is None:
        return spread(imagination.visited, count)
    reached = last.reached[:, :: max(1, TRIALS // (count // 2))]
    return torch.cat([spread(imagination.visited, count - reached.shape[1]), reached], 1)


def _settled(imagination: Imagination, start: Tensor, outcome: Outcome) -> Bool[Tensor, " L"]:
    """Whether walks that last earn all that is hoped for where they begin."""
    beyond = outcome.lasting * (imagination.hoped(start) - outcome.earned)
    lasting = outcome.lasting.mean(1)
    return (beyond.mean(1) <= lasting * imagination.margin) & (lasting > LEAST_LASTING)
