"""The numbers of Q-learning, each with its unit: they become the command line."""

import math
from dataclasses import dataclass
from typing import Literal

from torch_gprl.learners.ranges import check_choices, check_ranges
from torch_gprl.policies import Behaviour

Targets = Literal["fitted", "online"]
StateKernel = Literal["matern", "squared-exponential"]
CHOICES = {"targets": Targets, "kernel": StateKernel}

LEAST = {"total_frames": 1, "rollout_steps": 1, "budget": 1, "horizon": 1, "sweeps": 1, "candidates": 3}
POSITIVE = ("noise", "lengthscale", "action_lengthscale", "novelty_threshold")
SHARES = ("learning_rate", "growth")


@dataclass(frozen=True, kw_only=True)
class QLearningConfig(Behaviour):
    """Q-learning with a Gaussian process for the action value."""

    total_frames: int = 5_000  # environment steps per learner, over all its environments
    rollout_steps: int = 25  # steps of each environment between two looks at the critic
    discount: float = 0.95  # γ per environment step, at least 0 and below 1

    targets: Targets = "fitted"  # solve all experience anew, or the thesis' update of each rollout, once
    sweeps: int = 30  # most sweeps of value iteration in a solution; fitted
    growth: float = 0.1  # share by which experience grows between solutions; fitted
    hindsight: bool = True  # targets are at least what the episode attained; for little noise; fitted
    learning_rate: float = 1.0  # step from the old value to the target, from 0 to 1; online
    horizon: int = 1  # real rewards before the maximum over actions, m of (.8); online

    std: float = 0.6  # of the gaussian noise at first, in halves of the actuator's range
    candidates: int = 25  # actions compared in a maximisation
    optimism: float = 0.0  # what is not known is this many deviations of the value above its mean; fitted

    budget: int = 350  # basis vectors of the critic; too few, and what was solved is lost again
    novelty_threshold: float = 0.3  # novelty that makes a point a basis vector, in noise variances
    noise: float = 1e-3  # noise variance of targets, in their variances
    kernel: StateKernel = "matern"  # over states; Matérn 5/2 follows the ridges of values
    lengthscale: float = 1.0  # of observations, in their standard deviations times √columns
    action_lengthscale: float = 3.0  # of actions, in halves of the actuator's range

    def __post_init__(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: naming the field, its value and what would be valid.
        """
        super().__post_init__()
        check_ranges(self, least=LEAST, positive=POSITIVE, shares=SHARES, discounts=("discount",))
        if not math.isfinite(self.optimism):
            raise ValueError(f"optimism must be finite, got {self.optimism}")
        check_choices(self, CHOICES)
