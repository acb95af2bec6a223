"""Hamiltonian Monte Carlo in a box: many chains at once, reflected at the walls.

Neal (2011), "MCMC using Hamiltonian dynamics", section 5.5.1.5 for the walls: a position that would leave
comes back as from a mirror, with its momentum turned. The leapfrog stays reversible and keeps volumes, so the
Metropolis rule leaves the density as it is.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

LogDensity = Callable[[Tensor], Tensor]
"""Positions [learners, N, A] to log densities [learners, N] up to a constant; differentiable."""


@dataclass(frozen=True)
class HamiltonianConfig:
    """How chains move.

    Raises:
        ValueError: a number out of its range.
    """

    trajectories: int = 3  # for each sample
    steps: int = 8  # of the leapfrog in each trajectory
    warm_up: int = 100  # trajectories in which the step size is tuned
    acceptance: float = 0.8  # share of accepted trajectories at which tuning aims

    def __post_init__(self) -> None:
        """Refuse what cannot move."""
        if min(self.trajectories, self.steps) < 1 or self.warm_up < 0:
            raise ValueError(f"trajectories and steps must be at least 1, warm_up at least 0, got {self}")
        if not 0 < self.acceptance < 1:
            raise ValueError(f"acceptance must lie between 0 and 1, got {self.acceptance}")


class HamiltonianSampler(nn.Module):
    """Moves points in the box [−1, 1]^A so that they follow a density; one step size for each learner.

    Args:
        learners: independent groups of chains; none sees the others.
        config: how they move.
    """

    log_step: Float[Tensor, " learners"]
    acceptance: Float[Tensor, " learners"]
    moved: Tensor

    def __init__(self, learners: int, config: HamiltonianConfig) -> None:
        super().__init__()
        self.config = config
        first = torch.full((learners,), FIRST_STEP, dtype=torch.float64).log()
        self.register_buffer("log_step", first)
        self.register_buffer("acceptance", torch.full_like(first, torch.nan))  # of the last trajectory
        self.register_buffer("moved", torch.zeros((), dtype=torch.long))  # trajectories so far

    @property
    def step_size(self) -> Float[Tensor, " learners"]:
        """Time of a leapfrog step, in halves of the box over the momentum's standard deviation."""
        return self.log_step.exp()

    def random_numbers(self, dims: int) -> int:
        """Standard normal numbers that moving a point takes."""
        return self.config.trajectories * (dims + 1)

    @torch.no_grad()
    def move(
        self,
        log_density: LogDensity,
        position: Float[Tensor, "learners N A"],
        normal: Float[Tensor, "learners N R"],
    ) -> Float[Tensor, "learners N A"]:
        """The points after some trajectories.

        Args:
            log_density: what they should follow.
            position: where they are.
            normal: standard normal numbers, as many as `random_numbers` says.
        """
        dims = position.shape[-1]
        for part in normal.split(dims + 1, -1):
            momentum, chance = part[..., :dims], torch.special.ndtr(part[..., dims])
            position = self._trajectory(log_density, position, momentum, chance)
        return position

    def _trajectory(
        self, log_density: LogDensity, position: Tensor, momentum: Tensor, chance: Tensor
    ) -> Tensor:
        step = self.step_size[:, None, None].to(position)
        before, slope = _value_and_slope(log_density, position)
        energy = before - 0.5 * momentum.square().sum(-1)
        there, after = position, before
        for _ in range(self.config.steps):
            momentum = momentum + 0.5 * step * slope
            there, momentum = reflect(there + step * momentum, momentum)
            after, slope = _value_and_slope(log_density, there)
            momentum = momentum + 0.5 * step * slope
        change = after - 0.5 * momentum.square().sum(-1) - energy
        probability = change.clamp_max(0).exp().nan_to_num(0)
        self._tune(probability.mean(-1))
        return torch.where((chance < probability).unsqueeze(-1), there, position)

    def _tune(self, acceptance: Tensor) -> None:
        """Robbins and Monro's rule towards the wanted share, until the warm-up is over."""
        self.acceptance.copy_(acceptance)
        self.moved.add_(1)
        rate = (self.moved <= self.config.warm_up) * self.moved.to(self.log_step) ** -0.5
        self.log_step.add_(rate * (self.acceptance - self.config.acceptance)).clamp_(max=LONGEST_LOG_STEP)


FIRST_STEP = 0.1
LONGEST_LOG_STEP = 0.0  # half of the box: on flat densities everything is accepted


def reflect(position: Tensor, momentum: Tensor) -> tuple[Tensor, Tensor]:
    """Positions folded back into [−1, 1], each momentum turned as often as its wall was met."""
    phase = (position + 1).remainder(4)
    back = phase > 2
    return torch.where(back, 3 - phase, phase - 1), torch.where(back, -momentum, momentum)


def _value_and_slope(log_density: LogDensity, position: Tensor) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        leaf = position.detach().requires_grad_()
        value = log_density(leaf)
        (slope,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach(), slope
