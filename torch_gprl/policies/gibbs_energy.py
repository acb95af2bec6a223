"""The energy of Gibbs exploration: the thesis' equation (.16), and a robust sibling.

    printed   log π(a|s) = β Q̃(s, a) D(a) + const,   D(a) = exp(−‖a − f(s)‖²/2σ_e²)
    robust    log π(a|s) = β Q̃(s, a) − ‖a − f(s)‖²/2σ_e² + const

on the box of the actuator. Q̃ is the action value, shifted to a smallest value of 0 over the box and scaled
by its range there: only then has β a meaning across tasks, and the guidance of negative values its right
sign. Under the printed form every action far from f(s) is as likely as the worst; under the robust unlikely.
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

EnergyForm = Literal["printed", "robust"]


class Window(NamedTuple):
    """Where the guidance of the value reaches: round f(s), as far as σ_e."""

    loc: Float[Tensor, "*batch A"]
    width: Float[Tensor, "*batch A"]

    def square_distance(self, action: Float[Tensor, "*batch P A"]) -> Float[Tensor, "*batch P"]:
        """‖(a − f(s))/σ_e‖² of P actions at each state."""
        return ((action - self.loc.unsqueeze(-2)) / self.width.unsqueeze(-2)).square().sum(-1)


class ValueRange(NamedTuple):
    """Smallest value of each state over its actions, and how far the largest lies above."""

    least: Float[Tensor, "*batch"]
    extent: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, value: Float[Tensor, "*batch P"]) -> "ValueRange":
        """The range over P actions; 1 where all are worth the same, to the last digits."""
        least, most = value.aminmax(dim=-1)
        flat = most - least <= FLAT * torch.maximum(most.abs(), least.abs())
        return cls(least, torch.where(flat, 1.0, most - least))

    def preference(self, value: Float[Tensor, "*batch P"]) -> Float[Tensor, "*batch P"]:
        """Q̃: 0 for the worst action of the range, 1 for the best."""
        return (value - self.least.unsqueeze(-1)) / self.extent.unsqueeze(-1)


FLAT = 1e-12  # spread of values, relative to their size, that is roundoff


def log_density(
    form: EnergyForm,
    inverse_temperature: float | Tensor,
    preference: Float[Tensor, "*batch P"],
    action: Float[Tensor, "*batch P A"],
    window: Window,
) -> Float[Tensor, "*batch P"]:
    """Log π(a|s) up to a constant of each state, differentiable in preference, action and window.

    Args:
        form: "printed" or "robust".
        inverse_temperature: β; how sharply the value guides.
        preference: Q̃ of P actions at each state.
        action: the actions.
        window: f(s) and σ_e.
    """
    square = window.square_distance(action)
    if form == "printed":
        return inverse_temperature * preference * torch.exp(-0.5 * square)
    return inverse_temperature * preference - 0.5 * square
