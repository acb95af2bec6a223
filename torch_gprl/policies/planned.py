"""How a learner that plans behaves: one of several ways to stray from the best action of its plan, by name.

    optimism     a = argmax Q⁺(s, ·) + σ ε
    gaussian     a = argmax Q(s, ·) + σ ε
    confidence   a = argmax Q⁺(s, ·) + σ(s) ε,   σ²(s) = clip(scale · v(s, a))          equation (.15)
    gibbs        a = a' + σ ε,   a' ~ exp(β Q̃⁺(s, a') − ‖a' − f(s)‖²/2σ_e²)             equation (.16)

Q is the plan on what the model expects, f(s) its best action; Q⁺ is the plan that hopes for the best where
the model has no data, so it carries what is not known, here and on the way ahead; v is the share of a step
that the model does not know. Gibbs exploration draws from the actions that the planner compares. All begin
with smooth random actions, as long as there is no plan.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_gprl.critics.look_ahead import continued
from torch_gprl.critics.planned_value import PlannedValue
from torch_gprl.policies.confidence_noise import ConfidenceScale
from torch_gprl.policies.gaussian import explores
from torch_gprl.policies.gibbs import GibbsConfig
from torch_gprl.policies.gibbs_energy import EnergyForm, ValueRange, Window, log_density
from torch_gprl.policies.streams import NoiseStream

PlannedScheme = Literal["optimism", "gaussian", "confidence", "gibbs"]
INERTIA = 0.8  # of the first, random actions: those that follow each other are alike, and move the robot


@dataclass(frozen=True, kw_only=True)
class PlannedBehaviour:
    """A way to stray from planned actions, and its numbers.

    Raises:
        ValueError: another scheme, or a number out of its range.
    """

    exploration: PlannedScheme = "optimism"  # round the planned action; torch_gprl.policies.planned
    std: float = 0.1  # standard deviation of noise at first, in halves of the actuator's range
    final_std: float | None = None  # the same at last, in equal steps; as at first unless told
    noise_scale: float = 0.05  # confidence: σ² in squared halves of the range, where nothing is known
    least_std: float = 0.05  # confidence: floor of σ, in halves of the actuator's range
    most_std: float = 1.0  # confidence: ceiling of σ, in halves of the actuator's range
    gibbs_form: EnergyForm = "robust"  # gibbs: the thesis' energy, or its sibling that stays near f(s)
    inverse_temperature: float = 30.0  # gibbs: β at first, for values scaled by their range over the actions
    final_inverse_temperature: float = 100.0  # gibbs: β at last; it grows by equal factors
    gibbs_width: float = 2.0  # gibbs: σ_e, in halves of the range; as wide as all of it

    def __post_init__(self) -> None:
        """Refuse what is no behaviour."""
        if self.exploration not in get_args(PlannedScheme):
            known = ", ".join(get_args(PlannedScheme))
            raise ValueError(f"exploration must be one of {known}, got {self.exploration!r}")
        for name in ("std", "final_std"):
            if not 0 <= (getattr(self, name) or 0) < math.inf:
                raise ValueError(f"{name} must be at least 0 and finite, got {getattr(self, name)}")
        _ = self.confidence, self.gibbs  # each checks its own numbers

    @property
    def confidence(self) -> ConfidenceScale:
        """The numbers of confidence noise."""
        return ConfidenceScale(self.noise_scale, self.least_std, self.most_std)

    @property
    def gibbs(self) -> GibbsConfig:
        """The numbers of Gibbs exploration."""
        betas = self.inverse_temperature, self.final_inverse_temperature
        return GibbsConfig(self.gibbs_form, *betas, self.gibbs_width)


class PlannedPolicy(TensorDictModuleBase):
    """Acts on a plan as a `PlannedBehaviour` says; smooth random actions as long as there is none.

    Reads `observation` [L, envs, S], writes `action`. Under TorchRL's `ExplorationType.DETERMINISTIC` it acts
    on the plan that does not count on the unknown, without noise. Who has not settled looks ahead: `course`
    [L, envs, H, A], also written, is what it would do next, and goes on where the next tensordict has it.

    Args:
        value: the plan.
        low: lower bounds of the actions, [A].
        high: upper bounds.
        behaviour: what to do.
        seed: of all random numbers.
        learners: indices of the learners' streams.
    """

    def __init__(
        self,
        value: PlannedValue,
        low: Tensor,
        high: Tensor,
        behaviour: PlannedBehaviour,
        seed: int,
        learners: Sequence[int],
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action"]
        self.behaviour, self.noise = behaviour, NoiseStream(seed, learners)
        self._value, self._centre, self._half = value, (low + high) / 2, (high - low) / 2
        self._last: Tensor | None = None
        self.anneal(0.0)

    def anneal(self, share: float) -> None:
        """Set what changes as learning goes on, for a share of the training that is over, 0 to 1."""
        behaviour = self.behaviour
        last = behaviour.std if behaviour.final_std is None else behaviour.final_std
        self._std = behaviour.std + share * (last - behaviour.std)
        first, last = behaviour.inverse_temperature, behaviour.final_inverse_temperature
        self._inverse_temperature = first ** (1 - share) * last**share

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        observation = tensordict.get("observation")
        states = observation.to(self._half.dtype).reshape(len(observation), -1, observation.shape[-1])
        looks = self._value.looks_ahead and not explores()
        share = self._ahead(states, tensordict) if looks else self._share(states)
        share = share.reshape(*observation.shape[:-1], -1)
        return tensordict.set("action", (self._centre + share * self._half).to(observation.dtype))

    def _ahead(self, states: Tensor, tensordict: TensorDictBase) -> Float[Tensor, "L N A"]:
        """First actions of courses, for learners that have not settled; the rest goes to the tensordict."""
        last = tensordict.get("course", None)
        last = None if last is None else last.to(states).reshape(*states.shape[:2], *last.shape[-2:])
        course = self._value.course(states, last)
        rest = continued(course)
        tensordict.set("course", rest.reshape(*tensordict.batch_size, *rest.shape[-2:]))
        settled = self._value.settled
        if settled is None:
            return course[:, :, 0]
        return torch.where(settled, self._value.best_action(states, explore=False), course[:, :, 0])

    def _share(self, states: Tensor) -> Float[Tensor, "L N A"]:
        """Actions in halves of the actuator's range."""
        nothing = states.new_zeros(*states.shape[:2], len(self._half))
        if not explores():
            return self._value.best_action(states, explore=False) if self._value.planned else nothing
        if self._value.planned:
            return self._strayed(states, nothing)
        last = nothing if self._last is None else self._last
        self._last = torch.clamp(INERTIA * last + (1 - INERTIA**2) ** 0.5 * self.noise.draw(nothing), -1, 1)
        return self._last

    def _strayed(self, states: Tensor, like: Tensor) -> Float[Tensor, "L N A"]:
        """The scheme's action, or what is performed where there is nothing to explore for, and noise."""
        scheme = self.behaviour.exploration
        if scheme == "gibbs":
            draw = self.noise.draw(torch.cat([like, like[..., :1]], -1))
            action, noise = self._drawn(states, torch.special.ndtr(draw[..., :1])), draw[..., 1:]
        else:
            noise = self.noise.draw(like)
            action = self._value.best_action(states, explore=scheme != "gaussian")
        if self._value.settled is not None:
            action = torch.where(self._value.settled, self._value.best_action(states, explore=False), action)
        return torch.clamp(action + self.std_at(states, action) * noise, -1, 1)

    def std_at(self, states: Float[Tensor, "L N S"], action: Float[Tensor, "L N A"]) -> Tensor:
        """σ of the noise round actions [L, N, 1], all in halves of the actuator's range."""
        if self.behaviour.exploration != "confidence":
            return action.new_full((*action.shape[:2], 1), self._std)
        return self.behaviour.confidence.share(self._value.unknown(states, action)).unsqueeze(-1)

    def gibbs_shares(self, states: Float[Tensor, "L N S"]) -> Float[Tensor, "L N J"]:
        """Probabilities with which Gibbs exploration draws each of the plan's candidate actions."""
        value = self._value.candidate_values(states, explore=True)
        best = self._value.best_action(states, explore=False)
        energy = log_density(
            self.behaviour.gibbs_form,
            self._inverse_temperature,
            ValueRange.of(value).preference(value),
            self._value.acting_actions.expand(*states.shape[:2], -1, -1),
            Window(best, torch.full_like(best, self.behaviour.gibbs_width)),
        )
        return torch.softmax(energy, -1)

    def _drawn(self, states: Tensor, uniform: Float[Tensor, "L N 1"]) -> Float[Tensor, "L N A"]:
        """The candidate below which a share `uniform` of the probabilities lies."""
        below = self.gibbs_shares(states).cumsum(-1)
        index = torch.searchsorted(below, uniform * below[..., -1:]).squeeze(-1)
        return self._value.acting_actions[index]

    def state(self) -> dict[str, Any]:
        """Where the random numbers stand, for `restore`."""
        return {"noise": self.noise.state(), "last": self._last}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue where the random numbers stood."""
        self.noise.restore(state["noise"])
        self._last = state["last"]
