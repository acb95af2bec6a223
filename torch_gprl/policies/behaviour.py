"""How a learner of action values behaves: one of several ways to stray from its greedy actions, by name.

    gaussian     the same noise everywhere, with a share of uniform actions
    confidence   noise as wide as the critic is unsure, equation (.15)
    gibbs        by the action value near the greedy action, equation (.16)
    thompson     greedy on a function drawn from the posterior for each episode
    upper        greedy on the mean and some standard deviations

All begin with actions uniform in their box, until the critic has been taught.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false, reportAttributeAccessIssue=false

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.policies.confidence_noise import ConfidenceNoise, ConfidenceScale
from torch_gprl.policies.gaussian import explores
from torch_gprl.policies.gibbs import GibbsConfig, GibbsPolicy, Sampler
from torch_gprl.policies.gibbs_energy import EnergyForm
from torch_gprl.policies.greedy import GreedyPolicy
from torch_gprl.policies.optimistic import ThompsonSampling, UpperConfidence
from torch_gprl.policies.streams import NoiseStream

Scheme = Literal["gaussian", "confidence", "gibbs", "thompson", "upper"]
Explorer = GreedyPolicy | ConfidenceNoise | GibbsPolicy | ThompsonSampling | UpperConfidence


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """A way to stray from greedy actions, and its numbers.

    Raises:
        ValueError: another scheme, or a number out of its range.
    """

    exploration: Scheme = "gaussian"  # of the action round the greedy one; torch_gprl.policies.behaviour
    std: float = 0.3  # gaussian: standard deviation at first, in halves of the actuator's range
    final_std: float | None = None  # gaussian: the same at last, in equal steps; as at first unless told
    epsilon: float = 0.0  # gaussian: probability of an action uniform in the box
    noise_scale: float = 1.0  # confidence: σ² in squared halves of the range, for one target variance
    least_std: float = 0.05  # confidence: floor of σ, in halves of the actuator's range
    most_std: float = 1.0  # confidence: ceiling of σ, in halves of the actuator's range
    gibbs_form: EnergyForm = "robust"  # gibbs: the thesis' energy, or its sibling that stays near f(s)
    inverse_temperature: float = 3.0  # gibbs: β at first, for values scaled by their range over the actions
    final_inverse_temperature: float = 30.0  # gibbs: β at last; it grows by equal factors
    gibbs_width: float | None = 0.5  # gibbs: σ_e, in halves of the range; by the critic's variance if none
    gibbs_sampler: Sampler = "candidates"  # gibbs: who draws more than one action dimension
    bonus: float = 1.0  # upper: standard deviations of the value added to its mean

    def __post_init__(self) -> None:
        """Refuse what is no behaviour."""
        if self.exploration not in get_args(Scheme):
            known = ", ".join(get_args(Scheme))
            raise ValueError(f"exploration must be one of {known}, got {self.exploration!r}")
        for name in ("std", "final_std", "bonus"):
            if not 0 <= (getattr(self, name) or 0) < math.inf:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if not 0 <= self.epsilon <= 1:
            raise ValueError(f"epsilon must lie between 0 and 1, got {self.epsilon}")
        _ = self.confidence, self.gibbs  # each checks its own numbers

    @property
    def confidence(self) -> ConfidenceScale:
        """The numbers of confidence noise."""
        return ConfidenceScale(self.noise_scale, self.least_std, self.most_std)

    @property
    def gibbs(self) -> GibbsConfig:
        """The numbers of Gibbs exploration."""
        return GibbsConfig(
            self.gibbs_form,
            self.inverse_temperature,
            self.final_inverse_temperature,
            GibbsConfig.width if self.gibbs_width is None else self.gibbs_width,
            sampler=self.gibbs_sampler,
        )


class BehaviourPolicy(TensorDictModuleBase):
    """Acts as a `Behaviour` says; greedily under TorchRL's `ExplorationType.DETERMINISTIC`.

    Reads `observation` [learners, ..., S], Thompson sampling `step_count` too, and writes `action`.

    Args:
        behaviour: what to do.
        maximiser: of the critic, gives the greedy actions and their box.
        seed: of all random numbers.
        learners: indices of the learners' streams.

    Attributes:
        uniform: whether actions are uniform in their box, as at first; may be changed at any time.
    """

    policy: Explorer

    def __init__(
        self, behaviour: Behaviour, maximiser: ActionMaximiser, seed: int, learners: Sequence[int]
    ) -> None:
        super().__init__()
        self.behaviour, self.maximiser, self.uniform = behaviour, maximiser, True
        self.policy = _explorer(behaviour, maximiser, seed, learners)
        self._streams = NoiseStream(seed, learners)  # of upper confidence, which is random at first alone
        self.in_keys, self.out_keys = list(self.policy.in_keys), [str(maximiser.critic.in_keys[1])]

    @property
    def noise(self) -> NoiseStream:
        """The streams of its random numbers."""
        streams = self._streams if isinstance(self.policy, UpperConfidence) else self.policy.noise
        assert streams is not None
        return streams

    @noise.setter
    def noise(self, streams: NoiseStream) -> None:
        if isinstance(self.policy, UpperConfidence):
            self._streams = streams
        else:
            self.policy.noise = streams

    def anneal(self, share: float) -> None:
        """Set what changes as learning goes on, for a share of the training that is over, 0 to 1."""
        if isinstance(self.policy, GreedyPolicy):
            first, last = self.behaviour.std, self.behaviour.final_std
            self.policy.std = first if last is None else first + share * (last - first)
        elif isinstance(self.policy, GibbsPolicy):
            self.policy.anneal(share)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, and nothing else."""
        observation, key = tensordict.get(self.in_keys[0]), self.out_keys[0]
        if self.uniform and explores():
            low, high = self.maximiser.low, self.maximiser.high
            normal = self.noise.draw(low.new_empty(*observation.shape[:-1], len(low)))
            action = low + (high - low) * torch.special.ndtr(normal)
        else:
            action = self.policy(tensordict.select(*self.in_keys, strict=False)).get(key)
            action = action.clamp(self.maximiser.low, self.maximiser.high)
        return tensordict.set(key, action.to(observation.dtype))

    def exploration_state(self) -> dict[str, Any]:
        """Where exploration stands: tensors that `restore_exploration` takes."""
        return {"noise": self.noise.state(), "policy": self.policy.state_dict()}

    def restore_exploration(self, state: dict[str, Any]) -> None:
        """Continue where `exploration_state` stood."""
        self.noise.restore(state["noise"])
        self.policy.load_state_dict(state["policy"])


def _best_action(maximiser: ActionMaximiser, observation: Tensor) -> Tensor:
    return maximiser(observation).action


def _explorer(
    behaviour: Behaviour, maximiser: ActionMaximiser, seed: int, learners: Sequence[int]
) -> Explorer:
    greedy, critic = partial(_best_action, maximiser), maximiser.critic
    if behaviour.exploration == "confidence":
        return ConfidenceNoise(greedy, critic, behaviour.confidence, NoiseStream(seed, learners))
    if behaviour.exploration == "gibbs":
        width = behaviour.confidence if behaviour.gibbs_width is None else None
        return GibbsPolicy(greedy, critic, behaviour.gibbs, NoiseStream(seed, learners), width)
    if behaviour.exploration == "thompson":
        return ThompsonSampling(maximiser, seed, learners)
    if behaviour.exploration == "upper":
        return UpperConfidence(maximiser, behaviour.bonus)
    return GreedyPolicy(maximiser, behaviour.std, behaviour.epsilon, seed, learners)
