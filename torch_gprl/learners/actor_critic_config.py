"""The numbers of the actor-critic, each with its unit: they become the command line."""

from dataclasses import dataclass, field

from torch_gprl.learners.ranges import check_ranges
from torch_gprl.policies import ConfidenceScale

COUNTS = ("total_frames", "rollout_steps", "budget", "sweeps", "fit_steps", "batch", "hidden")
POSITIVE = ("amplitude", "noise", "lengthscale", "action_lengthscale", "trust_region", "learning_rate")
BELOW_ONE = ("discount", "growth")


@dataclass(frozen=True)
class ActorCriticConfig:
    """Actor-critic with a Gaussian process that solves all experience anew."""

    total_frames: int = 2_000  # environment steps per learner, over all its environments
    rollout_steps: int = 10  # steps of each environment between two looks at the critic
    discount: float = 0.96  # γ per environment step, from 0 to 1
    first_frames: int = 100  # environment steps per learner before it learns
    growth: float = 0.02  # share by which experience grows between two solutions

    # noise of the actions, wider where values are uncertain if floor and ceiling differ
    confidence: ConfidenceScale = field(default_factory=lambda: ConfidenceScale(100.0, 0.6, 0.6))

    sweeps: int = 4  # solutions of the critic in a row, each followed by a step of the policy
    trust_region: float = 0.5  # root mean square of a step of the policy, in halves of the actuator's range
    fit_steps: int = 10  # steps of Adam by which the controller follows a step of the policy
    batch: int = 128  # states in each of them
    learning_rate: float = 0.01  # of Adam
    hidden: int = 32  # units in each of the controller's two hidden layers

    budget: int = 300  # basis vectors of the critic
    amplitude: float = 0.5  # prior deviation of values, in deviations of the reward over 1 − γ
    noise: float = 3e-4  # noise variance of temporal differences, in variances of the reward
    lengthscale: float = 1.0  # of observations, in their standard deviations times √columns
    action_lengthscale: float = 6.0  # of actions, in halves of the actuator's range

    def __post_init__(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: naming the field, its value and what would be valid.
        """
        check_ranges(self, least=dict.fromkeys(COUNTS, 1), positive=POSITIVE, discounts=BELOW_ONE)
