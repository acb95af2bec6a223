"""What a plan is made of: its numbers, the range of its values, support states, where actions lead."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.critics.transition_model import Transitions


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
    look_ahead: int = 20  # steps of the courses compared before acting; 0: do not look ahead
    variations: int = 48  # of the last course, in each comparison, for each column of the action


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


def attainable(
    data: Transitions, planning: Planning
) -> tuple[Float[Tensor, "L 1"], Float[Tensor, "L 1"], Float[Tensor, "L 1"]]:
    """The lowest and highest value that rewards of the experience can give, and what is hoped for beyond."""
    ended, horizon = data.terminated > 0.5, 1 - planning.discount
    # V is a mean of what is paid for ever and of what an end pays once
    for_ever = torch.where(ended, torch.nan, data.reward / horizon)
    once, nothing = (torch.where(ended, paid, torch.nan) for paid in (data.reward, 0.0))
    values = torch.cat([for_ever, once, nothing], 1)
    low = values.nan_to_num(torch.inf).amin(1, keepdim=True)
    high = values.nan_to_num(-torch.inf).amax(1, keepdim=True)
    # an end pays once: the hope for more than was seen is for steps that pay more
    most, least = for_ever.nan_to_num(-torch.inf).amax(1), for_ever.nan_to_num(torch.inf).amin(1)
    extent = torch.where(high > low, (most - least).unsqueeze(1), 1.0)  # 1: all is alike yet
    return low, high, high + planning.optimism * extent


def trembling_weights(actions: Float[Tensor, "J A"], width: float) -> Float[Tensor, "J J"]:
    """Weights by which the value of an action is averaged over actions near it."""
    away = torch.cdist(actions, actions, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.softmax(-0.5 * (away / width).square(), -1)
