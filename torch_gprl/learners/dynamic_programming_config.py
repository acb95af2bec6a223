"""The numbers of dynamic programming on a learned model, each with its unit: they become the command line."""

from dataclasses import dataclass, fields

from torch_gprl.critics.plan import Planning
from torch_gprl.learners.ranges import check_ranges
from torch_gprl.policies import PlannedBehaviour

LEAST = {
    "total_frames": 1,
    "rollout_steps": 1,
    "first_steps": 2,
    "model_budget": 1,
    "support": 1,
    "imagined": 0,
    "sweeps": 1,
    "backup_actions": 3,
    "acting_actions": 3,
    "hold": 1,
    "rehearsal": 0,
    "ascents": 0,
    "look_ahead": 0,
    "variations": 0,
    "optimism": 0,
    "growth": 0,
}
POSITIVE = ("lengthscale", "novelty_lengthscale", "tremble")


@dataclass(frozen=True, kw_only=True)
class DynamicProgrammingConfig(PlannedBehaviour):
    """Dynamic programming on Gaussian-process models of the steps and of the value."""

    total_frames: int = 2_000  # environment steps per learner, over all its environments
    rollout_steps: int = 25  # steps of each environment between two looks at the plan
    first_steps: int = 50  # environment steps per learner of random actions, before the first plan
    growth: float = 0.1  # share by which experience grows between plans
    discount: float = 0.98  # γ per environment step, from 0 to 1, 1 excluded

    model_budget: int = 400  # basis vectors of the model of the steps
    support: int = 200  # states whose values are planned
    imagined: int = 300  # imagined states that the support is chosen from, besides visited ones
    sweeps: int = 40  # of value iteration in each plan
    backup_actions: int = 9  # actions compared in a sweep
    acting_actions: int = 21  # actions compared when acting
    lengthscale: float = 2.0  # of values, in standard deviations of the observations times √columns
    novelty_lengthscale: float = 1.0  # in which a state counts as new, likewise
    tremble: float = 0.25  # standard deviation of actions to plan for, in halves of the actuator's range
    hold: int = 2  # environment steps that a plan holds an action for; acting chooses anew at every step
    smoothness: float = 0.5  # of values, as in Matérn kernels: 0.5, 1.5 or 2.5
    rehearsal: int = 60  # steps of the imagined walks that improve what is performed; 0: perform the plan
    ascents: int = 12  # gradient steps of a rehearsal
    look_ahead: int = 20  # steps of the courses compared before acting without exploration; 0: none
    variations: int = 48  # of the last course, in each comparison, for each column of the action

    optimism: float = 1.0  # exploring hopes for the best seen, and so many ranges of what steps pay more

    def __post_init__(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: naming the field, its value and what would be valid.
        """
        super().__post_init__()
        check_ranges(self, least=LEAST, positive=POSITIVE, discounts=("discount",))
        if self.smoothness not in (0.5, 1.5, 2.5):
            raise ValueError(f"smoothness must be 0.5, 1.5 or 2.5, got {self.smoothness}")

    @property
    def planning(self) -> Planning:
        """The numbers of a plan."""
        return Planning(**{each.name: getattr(self, each.name) for each in fields(Planning)})
