"""Exploration by the critic's doubt about the value itself: Thompson sampling and upper confidence.

    Thompson           a = argmax_a f(s, a),   f a function drawn from the posterior of Q for a whole episode
    upper confidence   a = argmax_a Q(s, a) + κ √v(s, a)

Thompson (1933); Osband, Van Roy and Wen (2016) for a function kept through an episode, which explores deeply
where noise that is drawn at every step dithers; Auer (2002) for upper confidence.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false, reportAttributeAccessIssue=false

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_gprl.critics.maximise import ActionMaximiser, ascend
from torch_gprl.gp.sample_paths import Paths, PathSampler
from torch_gprl.policies.gaussian import explores
from torch_gprl.policies.streams import NoiseStream, learner_generators

ASCENT_STEPS = 2  # from the best candidate


class MaximisingPolicy(TensorDictModuleBase, ABC):
    """Writes the action that maximises some opinion of the value; the critic's own mean to exploit.

    Args:
        maximiser: of the critic's mean; gives the box and the candidates too.
    """

    def __init__(self, maximiser: ActionMaximiser) -> None:
        super().__init__()
        observation_key, action_key = map(str, maximiser.critic.in_keys)
        self.in_keys, self.out_keys = [observation_key], [action_key]
        self.maximiser = maximiser

    @abstractmethod
    def opinion(
        self, observation: Float[Tensor, "*batch E S"], action: Float[Tensor, "*batch E P A"]
    ) -> Float[Tensor, "*batch E P"]:
        """What to maximise, at P actions of each state, differentiable in them."""

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        observation = tensordict.get(self.in_keys[0])
        if not explores():
            action = self.maximiser(observation).action
        else:
            states = observation.reshape(*self.maximiser.critic.gp.batch_shape, -1, observation.shape[-1])
            action = self._maximise(states).reshape(*observation.shape[:-1], -1)
        return tensordict.set(self.out_keys[0], action.to(observation.dtype))

    def _maximise(self, states: Tensor) -> Tensor:
        """The best candidate, improved by gradient steps, [*batch, E, A]."""
        box = self.maximiser
        candidates = box.candidates.expand(*states.shape[:-1], -1, -1)
        start = box.candidates[self.opinion(states, candidates).argmax(-1)]

        def value(observation: Tensor, action: Tensor) -> Tensor:
            return self.opinion(observation, action.unsqueeze(-2)).squeeze(-1)

        return ascend(value, states, start, box.low, box.high, box.stride / 2, ASCENT_STEPS).action

    def _inputs(self, observation: Tensor, action: Tensor) -> Float[Tensor, "*batch EP D"]:
        """The process' inputs for P actions of each of E states, as points."""
        spread = observation.unsqueeze(-2).expand(*action.shape[:-1], -1)
        return self.maximiser.critic.inputs(spread, action)


class UpperConfidence(MaximisingPolicy):
    """Acts as if everything were as good as it may well be.

    Args:
        maximiser: of the critic's mean.
        optimism: κ, how many standard deviations above the mean.

    Raises:
        ValueError: a negative optimism.
    """

    def __init__(self, maximiser: ActionMaximiser, optimism: float = 1.0) -> None:
        if not optimism >= 0:
            raise ValueError(f"optimism must be at least 0 standard deviations, got {optimism}")
        super().__init__(maximiser)
        self.optimism = optimism

    def opinion(
        self, observation: Float[Tensor, "*batch E S"], action: Float[Tensor, "*batch E P A"]
    ) -> Float[Tensor, "*batch E P"]:
        """Mean and κ standard deviations, in the process' own units."""
        posterior = self.maximiser.critic.gp.posterior(self._inputs(observation, action))
        upper = posterior.mean + self.optimism * posterior.variance.clamp_min(LEAST_VARIANCE).sqrt()
        return upper.reshape(action.shape[:-1])


LEAST_VARIANCE = 1e-12  # roundoff of the posterior's; the root's slope is infinite at 0


class ThompsonSampling(MaximisingPolicy):
    """Acts on one function drawn from the posterior for each episode.

    Reads `step_count` too, as TorchRL's `StepCounter` writes it: where it is 0 an episode begins. When the
    critic learns in the middle of an episode, the function is seen in the light of the new data.

    Args:
        maximiser: of the critic's mean; with a kernel that `PathSampler` knows.
        seed: of the functions.
        learners: indices of the learners' streams.
        features: random frequencies of the prior's functions.

    Raises:
        TypeError: a kernel whose spectrum is not known.
    """

    def __init__(
        self, maximiser: ActionMaximiser, seed: int = 0, learners: Sequence[int] = (0,), features: int = 128
    ) -> None:
        super().__init__(maximiser)
        self.in_keys = [*self.in_keys, "step_count"]
        generators = learner_generators(seed, learners, "weights")
        self.sampler = PathSampler(maximiser.critic.gp, features, generators)
        self.noise = NoiseStream(seed, learners)
        self._normal: Tensor | None = None
        self._paths: Paths | None = None

    def get_extra_state(self) -> dict[str, Any]:
        """The present episodes' functions, for `state_dict`."""
        normal = torch.zeros(0) if self._normal is None else self._normal
        return {"normal": normal, "frequencies": [factor.frequencies for factor in self.sampler.factors]}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Continue the functions of a `state_dict`."""
        self._normal = state["normal"] if state["normal"].numel() else None
        saved = zip(self.sampler.factors, state["frequencies"], strict=True)
        self.sampler.factors = [factor._replace(frequencies=frequencies) for factor, frequencies in saved]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        if explores():
            self._begin(tensordict.get("step_count").flatten(1) == 0)
        return super().forward(tensordict)

    def _begin(self, beginning: Tensor) -> None:
        """Draw new functions where an episode begins, [learners, E], and condition all on today's data."""
        # every learner draws at every step: what one draws must not depend on the episodes of others
        fresh = self.noise.draw(self.maximiser.low.new_empty(*beginning.shape, self.sampler.random_numbers))
        kept = fresh if self._normal is None or self._normal.shape != fresh.shape else self._normal
        self._normal = torch.where(beginning.unsqueeze(-1), fresh, kept)
        self._paths = self.sampler.draw(
            self._normal.reshape(*self.sampler.gp.batch_shape, -1, fresh.shape[-1])
        )

    def opinion(
        self, observation: Float[Tensor, "*batch E S"], action: Float[Tensor, "*batch E P A"]
    ) -> Float[Tensor, "*batch E P"]:
        """The episodes' functions, in the process' own units."""
        assert self._paths is not None
        inputs = self._inputs(observation, action).reshape(*action.shape[:-1], -1)
        return self.sampler.values(self._paths, inputs)
