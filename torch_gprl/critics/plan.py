"""What a plan is made of: its numbers, support states and their values, and where actions lead."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


@dataclass(frozen=True)
class Planning:
    """The numbers of a plan."""

    discount: float = 0.98  # γ per environment step
    support: int = 200  # states whose values are planned, besides ends
    imagined: int = 300  # imagined states that the support is chosen from, besides visited ones
    sweeps: int = 40  # of value iteration, in each plan
    backup_actions: int = 9  # actions compared in a sweep
    lengthscale: float = 2.0  # of values, in the observations' standard deviations times √columns
    novelty_lengthscale: float = 1.0  # in which a state counts as new, likewise
    tremble: float = 0.25  # standard deviation of actions that is planned for, in halves of their range
    optimism: float = 1.0  # hope for the best seen, and so many ranges of what steps pay more
    hold: int = 2  # environment steps that an action is held for
    smoothness: float = 0.5  # of values, as in Matérn kernels: 0.5, 1.5 or 2.5
    rehearsal: int = 60  # steps of the imagined walks that improve what is performed; 0: perform the plan
    ascents: int = 12  # gradient steps of a rehearsal


class Support(NamedTuple):
    """Where values are known, in standardised and scaled coordinates, and what they are."""

    observation: Tensor  # [L, M, S] states, without the ends
    scaled: Tensor  # [L, M + E, S] with the ends
    ends: Tensor  # [L, E] 1 for an end, 0 for an empty place
    loc: Tensor  # [L, 1, S] of the scaling
    scale: Tensor  # [L, 1, S]
    prior: Tensor  # [L, 1, 2] mean of the values where nothing is known
    weights: Tensor  # [L, M + E, 2]


class Course(NamedTuple):
    """Where an action leads that is held for some steps."""

    observation: Tensor  # [L, N, S] in the end
    reward: Tensor  # [L, N] in all, discounted
    lasting: Tensor  # [L, N] the chance, 0 to 1, that the task goes on
    doubt: Tensor  # [L, N] about the first step, as `Prediction`
