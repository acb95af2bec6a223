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

Reality outweighs imagination: a settled learner keeps a policy, whatever the model says of it or promises
elsewhere, that has done without fault as many real steps as a comparison imagines; each fault since then
must be paid with four times as many. A fault is an end, or a step that is paid less than the most there is;
who has met no end yet has proved nothing, and may not know what there is. The model errs about what drifts
slowly, and who holds a pole for hundreds of steps has nothing to gain by a change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.critics.rehearsal import Outcome, SmoothPolicy, Walks, rehearse, spread
from torch_gprl.critics.transition_model import Transitions

WALKS, TRIALS = 16, 8  # imagined walks: to rehearse, and to compare
LONGER = 2  # times as many steps as a rehearsal: a comparison
FAULT = 4  # comparisons' worth of real steps that make up for a fault
LEAST_LASTING = 0.1  # chance of going on to the end of a walk, of a learner that has settled
NOTHING = 0.01  # share of the range of values that is not worth exploring for, or a change
KEPT = ("smooth", "settled", "reached", "since")  # of what is performed, besides the policy
Map = Callable[[Float[Tensor, "L N S"]], Tensor]


@dataclass(frozen=True)
class Imagination:
    """What a learner can imagine, and what it has seen.

    Args:
        walks: states to begin from and a number of steps, to walks through the model.
        planned: states to the best actions of the plan.
        roughly: the same, out of fewer actions.
        hoped: states to what the exploring plan hopes for there [L, N].
        data: the experience.
        low: [L] the lowest value that is attainable.
        high: [L] the highest.
        discount: γ per step.
    """

    walks: Callable[[Tensor, int], Walks]
    planned: Map
    roughly: Map
    hoped: Map
    data: Transitions
    low: Tensor
    high: Tensor
    discount: float

    @property
    def margin(self) -> Float[Tensor, " L"]:
        """Difference of values that does not count."""
        return NOTHING * (self.high - self.low)

    def faults(self, since: Float[Tensor, " L"]) -> Float[Tensor, " L"]:
        """How many steps after the first so many ended the task, or were paid less than the most there is."""
        enough = (1 - self.discount) * (self.high - self.margin)
        fault = (self.data.terminated > 0.5) | (self.data.reward < enough.unsqueeze(-1))
        late = torch.arange(fault.shape[1], device=fault.device) >= since.unsqueeze(-1)
        return (fault & late).sum(1).to(since)


class Performance:
    """What learners perform.

    Args:
        policy: the smooth one in hand.
        smooth: [L, 1, 1] whether it is what is performed, else the plan.
        settled: [L, 1, 1] whether there is nothing left to explore for.
        reached: [L, N, S] where performing has led in imagination.
        since: [L, 1, 1] steps of experience after which a policy was performed that is kept since then.
    """

    def __init__(
        self, policy: SmoothPolicy, smooth: Tensor, settled: Tensor, reached: Tensor, since: Tensor
    ) -> None:
        self.policy, self.smooth, self.settled = policy, smooth, settled
        self.reached, self.since = reached, since
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
        pairs = ((getattr(self, name), getattr(other, name)) for name in KEPT)
        return Performance(policy, *(torch.where(chosen, ours, theirs) for ours, theirs in pairs))

    def state_dict(self) -> dict[str, Any]:
        """All that it was made of."""
        return {"policy": self.policy.state_dict()} | {name: getattr(self, name) for name in KEPT}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "Performance":
        """What `state_dict` was taken of."""
        return cls(SmoothPolicy.restored(state["policy"]), *(state[name] for name in KEPT))


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
    proven = _proven(imagination, last, LONGER * steps)
    if last is not None and proven.all():
        return last
    planned = imagination.planned(policy.states)
    choices = [planned] if last is None else [last.policy(policy.states), planned]
    rehearse(imagination.walks(_starts(imagination, last, WALKS), steps), policy, choices, ascents)
    chosen = _compared(imagination, policy, last, LONGER * steps)
    return chosen if last is None else last.where(proven.view(-1, 1, 1), chosen)


def _proven(imagination: Imagination, last: Performance | None, steps: int) -> Bool[Tensor, " L"]:
    """Who has settled on a policy that lasted for so many real steps, and more for each fault."""
    if last is None:
        return torch.zeros_like(imagination.margin, dtype=torch.bool)
    since = last.since.flatten()
    kept = imagination.data.observation.shape[1] - since
    lasted = kept >= steps * (1 + FAULT * imagination.faults(since))
    tested = (imagination.data.terminated > 0.5).any(1)
    return (last.smooth & last.settled).flatten() & lasted & tested


def _compared(
    imagination: Imagination, policy: SmoothPolicy, last: Performance | None, steps: int
) -> Performance:
    """The best of a new policy, the one in hand and the plan, in walks of so many steps."""
    trial = imagination.walks(_starts(imagination, last, TRIALS), steps)
    outcome = trial.walk(policy)
    held, stays = torch.zeros(2, len(imagination.margin), dtype=torch.bool, device=policy.states.device)
    if last is not None:
        held = (last.smooth & last.settled).flatten()  # who has settled on a policy
        before = trial.walk(last.policy)
        stays = before.earned.mean(1) + held * imagination.margin >= outcome.earned.mean(1)
        policy, outcome = last.policy.where(stays, policy), before.where(stays, outcome)
    by_plan = trial.walk(imagination.roughly)
    gain = outcome.earned.mean(1) - by_plan.earned.mean(1)
    smooth = gain > torch.where(held, -imagination.margin, imagination.margin)
    outcome = outcome.where(smooth, by_plan)
    settled = _settled(imagination, trial.start, outcome)
    since = torch.full_like(imagination.margin, imagination.data.observation.shape[1]).view(-1, 1, 1)
    if last is not None:
        since = torch.where((held & stays & smooth).view(-1, 1, 1), last.since, since)
    return Performance(policy, smooth.view(-1, 1, 1), settled.view(-1, 1, 1), outcome.halfway, since)


def _starts(imagination: Imagination, last: Performance | None, count: int) -> Float[Tensor, "L M S"]:
    """So many states to begin walks from."""
    if last is None:
        return spread(imagination.data.observation, count)
    reached = last.reached[:, :: max(1, TRIALS // (count // 2))]
    return torch.cat([spread(imagination.data.observation, count - reached.shape[1]), reached], 1)


def _settled(imagination: Imagination, start: Tensor, outcome: Outcome) -> Bool[Tensor, " L"]:
    """Whether walks that last earn all that is hoped for where they begin."""
    beyond = outcome.lasting * (imagination.hoped(start) - outcome.earned)
    lasting = outcome.lasting.mean(1)
    return (beyond.mean(1) <= lasting * imagination.margin) & (lasting > LEAST_LASTING)
