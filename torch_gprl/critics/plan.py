"""What a plan is made of: support states and their values, what judges states, and where actions lead."""

from typing import NamedTuple

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
