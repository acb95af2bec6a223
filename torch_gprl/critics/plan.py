"""What a plan is made of: support states and their values, what judges states, and where actions lead."""

from typing import NamedTuple

import torch
from torch import Tensor


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


def take(new: Support, old: Support, better: Tensor) -> Support:
    """The new plan for the learners [L] where it is better, the old one for the others."""
    return Support(
        *(
            torch.where(better.view(-1, *[1] * (ours.ndim - 1)), ours, theirs)
            for ours, theirs in zip(new, old, strict=True)
        )
    )


def with_places(plan: Support, places: int, nowhere: float) -> Support:
    """The plan with so many places for ends; what it has not filled lies `nowhere`, far from all states."""
    more = places - plan.ends.shape[1]

    def filled(values: Tensor, number: float) -> Tensor:
        return torch.cat([values, values.new_full((len(values), more, *values.shape[2:]), number)], 1)

    return plan._replace(
        scaled=filled(plan.scaled, nowhere), ends=filled(plan.ends, 0.0), weights=filled(plan.weights, 0.0)
    )
