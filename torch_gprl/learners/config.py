"""The numbers of policy-gradient learning, each with its unit: they become the command line."""

from dataclasses import dataclass
from typing import Literal

from torch_gprl.critics import USE_ALL_ACTIONS, EstimatorName, KernelName
from torch_gprl.learners.ranges import check_choices, check_ranges
from torch_gprl.policies.gibbs_energy import EnergyForm

ControllerForm = Literal["linear", "rbf", "mlp"]
CriticForm = Literal["gp", "neural"]
Optimiser = Literal["natural", "episodic-natural", "adam", "plain"]
Exploration = Literal["learned", "fixed", "scheduled", "confidence", "gibbs"]
GUIDED = ("confidence", "gibbs")  # explorations that ask the critic
Targets = Literal["returns", "differences"]
AgeForm = Literal["exponential", "logit"]

CHOICES = {
    "critic": CriticForm,
    "estimator": EstimatorName,
    "kernel": KernelName,
    "controller": ControllerForm,
    "optimiser": Optimiser,
    "exploration": Exploration,
    "gibbs_form": EnergyForm,
    "targets": Targets,
    "age_form": AgeForm,
}
# What a critic of states alone can weigh actions by.
BY_STATE_VALUES = (
    "return",
    "reward-to-go",
    "mean-baseline",
    "optimal-baseline",
    "value-baseline",
    "k-step-baseline",
    "generalised",
)
LEAST = {
    "total_frames": 1,
    "rollout_steps": 1,
    "budget": 1,
    "visited": 20,
    "renew_every": 1,
    "horizon": 0,
    "replay": 0,
    "solved": 1,
    "improvements": 0,
    "average_over": 1,
}
POSITIVE = (
    "std",
    "final_std",
    "inverse_temperature",
    "final_inverse_temperature",
    "trust_region",
    "damping",
    "learning_rate",
    "noise",
    "lengthscale",
    "action_lengthscale",
    "age_timescale",
)
SHARES = ("discount", "trace", "age_weight")


@dataclass(frozen=True)
class PolicyGradientConfig:
    """Policy gradients with a Gaussian-process critic."""

    total_frames: int = 120_000  # environment steps per learner, over all its environments
    rollout_steps: int = 200  # steps of each environment between two policy updates
    discount: float = 0.98  # γ per environment step, from 0 to 1
    discount_states: bool = False  # weigh step t of an episode by γ^t, the gradient of the discounted return

    critic: CriticForm = "gp"  # Q(s, a) by a Gaussian process, or V(s) by a neural network
    estimator: EstimatorName = "generalised"  # how good an action was; torch_gprl.critics.estimators
    horizon: int = 200  # real rewards before the critic's value takes over, in the k-step estimators
    trace: float = 0.9  # λ of the estimator "generalised", from 0 to 1

    controller: ControllerForm = "mlp"  # form of the controller f(s)
    exploration: Exploration = "learned"  # standard deviation learned, fixed, scheduled; or by the critic
    std: float = 0.5  # σ at first, in halves of the actuator's range; confidence: for one target variance
    final_std: float = 0.1  # σ at last if scheduled, at least for confidence; in halves of the range
    gibbs_form: EnergyForm = "robust"  # gibbs: the thesis' energy, or its sibling that stays near f(s)
    inverse_temperature: float = 3.0  # gibbs: β at first, for values scaled by their range over the actions
    final_inverse_temperature: float = 30.0  # gibbs: β at last, by equal factors; its σ_e is std
    optimiser: Optimiser = "natural"  # natural gradient, the same by regression on episodes, Adam, or plain
    trust_region: float = 0.05  # KL divergence of the first natural step, nats; falls linearly to 0
    damping: float = 1e-3  # of the natural gradient: shares of the mean Fisher information along the gradient
    learning_rate: float = 0.01  # of Adam and of the plain gradient; falls linearly to 0
    average_over: int = 1  # steps of the policy whose mean acts when nothing is explored; 1: the newest

    targets: Targets = "returns"  # the critic learns values from returns, or rewards as temporal differences
    in_sample: bool = False  # the critic learns a rollout before it judges it
    kernel: KernelName = "squared-exponential"  # of states, times one of actions; "successor-actions": both
    visited: int = 1_000  # newest transitions that "geodesic", "successor" and "successor-actions" stand on
    budget: int = 150  # basis vectors of the critic; a replay in 4 dimensions wants a fifth of its steps
    novelty_threshold: float = 0.3  # novelty that makes a point a basis vector, in noise variances
    renew_every: int = 20  # policy updates between renewals of the critic, which forget older data; 1: each
    replay: int = 0  # newest environment steps per learner to keep and solve anew at each update; 0: none
    solved: int = 4_000  # of these, most that are solved at once: those farthest apart
    improvements: int = 0  # further steps at each update, by the critic at replayed states; with "all-action"
    noise: float = 0.02  # noise variance of temporal differences, in variances of the reward
    lengthscale: float = 0.3  # of observations, in their standard deviations times √columns; differences
    action_lengthscale: float = 12.0  # of actions, in their standard deviations; differences
    age_weight: float = 0.0  # λ: pruning by information (0) or by age (1)
    age_form: AgeForm = "exponential"  # of the age in the pruning score
    age_timescale: float = 10.0  # policy updates in which the exponential form falls to 1/e

    def __post_init__(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: naming the field, its value and what would be valid.
        """
        check_ranges(self, least=LEAST, positive=POSITIVE, shares=SHARES)
        check_choices(self, CHOICES)
        self._check_combinations()
        self._check_exploration()

    def _check_combinations(self) -> None:
        if self.replay and self.targets != "differences":
            raise ValueError("replay solves temporal differences anew and needs targets 'differences'")
        if self.replay and not 0 < self.discount < 1:
            raise ValueError(f"replay needs a discount between 0 and 1, got {self.discount}")
        if self.improvements and (not self.replay or self.estimator != "all-action" or self.discount_states):
            raise ValueError(
                "improvements need a replay, estimator 'all-action' and discount_states off, got replay "
                f"{self.replay}, {self.estimator!r} and {self.discount_states}"
            )
        if self.kernel in ("geodesic", "successor", "successor-actions") and not 0 < self.discount < 1:
            raise ValueError(f"kernel {self.kernel!r} needs a discount between 0 and 1, got {self.discount}")
        if self.critic == "neural" and self.estimator not in BY_STATE_VALUES:
            choices = ", ".join(BY_STATE_VALUES)
            raise ValueError(
                f"critic 'neural' knows no action values; choose one of {choices}, got {self.estimator!r}"
            )
        if self.critic == "neural" and self.estimator == "k-step-baseline" and self.horizon == 0:
            raise ValueError("critic 'neural' needs at least one real reward: horizon 1 or more, got 0")
        if self.optimiser == "episodic-natural" and self.estimator != "return":
            raise ValueError(
                "optimiser 'episodic-natural' regresses returns of episodes and needs estimator 'return', "
                f"got {self.estimator!r}"
            )

    def _check_exploration(self) -> None:
        if self.exploration in GUIDED and self.critic != "gp":
            raise ValueError(
                f"exploration {self.exploration!r} asks the variance or the values of critic 'gp'"
            )
        if self.exploration in GUIDED and self.average_over > 1:
            raise ValueError(
                f"exploration {self.exploration!r} acts by the newest parameters and needs average_over 1, "
                f"got {self.average_over}"
            )
        if self.exploration == "gibbs" and self.estimator in USE_ALL_ACTIONS:
            raise ValueError(f"estimator {self.estimator!r} averages over a normal policy, not over gibbs")
