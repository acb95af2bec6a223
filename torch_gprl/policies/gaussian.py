"""The Gaussian policy of the thesis' equation (.1): a = f(s, θ) + σ ε, with 2σ² in the exponent."""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.nn.probabilistic import InteractionType, interaction_type
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.modules import IndependentNormal

from torch_gprl.policies.controllers import Controller
from torch_gprl.policies.streams import NoiseStream


class ActionHead(TensorDictModuleBase, ABC):
    """Writes the mean `loc` and the standard deviation `scale` of the action, in the actuator's units."""

    def __init__(self, observation_key: str) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [observation_key], ["loc", "scale"]

    @abstractmethod
    def parameters_at(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation [*batch, ..., A] of the action at observations [*batch, ..., D]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `loc` and `scale`."""
        loc, scale = self.parameters_at(tensordict.get(self.in_keys[0]))
        return tensordict.set("loc", loc).set("scale", scale)


class GaussianHead(ActionHead):
    """A controller and a standard deviation of its own for every dimension of the action."""

    centre: Float[Tensor, " A"]
    half_range: Float[Tensor, " A"]

    def __init__(
        self, controller: Controller, low: Tensor, high: Tensor, std: float, observation_key: str
    ) -> None:
        super().__init__(observation_key)
        self.controller = controller
        self.register_buffer("centre", (high + low) / 2)
        self.register_buffer("half_range", (high - low) / 2)
        shape = (*controller.batch_shape, controller.action_dim)
        self.log_std = nn.Parameter(high.new_full(shape, std).log())

    def parameters_at(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation [*batch, ..., A] of the action at observations [*batch, ..., D]."""
        loc = self.centre + self.half_range * self.controller(observation)
        std = self.half_range * self.log_std.exp()
        middle = (1,) * (loc.ndim - std.ndim)
        return loc, std.reshape(*std.shape[:-1], *middle, std.shape[-1]).expand_as(loc)


class NormalPolicy(ProbabilisticTensorDictSequential):
    """Normally distributed actions, as TorchRL's losses and collectors take a policy.

    Writes `loc`, `scale`, `action` and `action_log_prob`. With a `noise` stream, what learner i draws does
    not depend on the other learners; acting is then one fused step instead of TorchRL's chain of modules.
    """

    def __init__(
        self, head: ActionHead, noise: NoiseStream | None = None, action_key: str = "action"
    ) -> None:
        sampler = ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=[action_key],
            distribution_class=IndependentNormal,
            return_log_prob=True,
            default_interaction_type=InteractionType.RANDOM,  # pyright: ignore[reportArgumentType]
        )
        super().__init__([head, sampler])
        self.noise = noise
        self.action_key = action_key

    def forward(self, tensordict: TensorDictBase, *args: object, **kwargs: object) -> TensorDictBase:
        """Write the distribution's parameters, an action and its log-probability."""
        if self.noise is None or not explores():
            return super().forward(tensordict, *args, **kwargs)
        head = self.module[0]
        assert isinstance(head, ActionHead)
        loc, scale = head.parameters_at(tensordict.get(head.in_keys[0]))
        noise = self.noise.draw(loc.reshape(len(self.noise), -1, loc.shape[-1])).reshape(loc.shape)
        # log N(a; f, σ²I) with a − f = σ ε
        log_prob = -(0.5 * noise.square() + scale.log() + 0.5 * LOG_2PI).sum(-1)
        tensordict.set("loc", loc).set("scale", scale).set(self.action_key, loc + scale * noise)
        return tensordict.set(f"{self.action_key}_log_prob", log_prob)


class GaussianPolicy(NormalPolicy):
    """A Gaussian of a standard deviation of its own round a controller."""

    @property
    def head(self) -> GaussianHead:
        """The module of mean and standard deviation."""
        head = self.module[0]
        assert isinstance(head, GaussianHead)
        return head

    @property
    def std(self) -> Float[Tensor, "*batch A"]:
        """Standard deviation of the exploration, in the actuator's units."""
        return (self.head.half_range * self.head.log_std.exp()).detach()


def explores() -> bool:
    """Whether TorchRL's exploration type asks for random actions, as it does unless told otherwise."""
    return interaction_type() in (InteractionType.RANDOM, None)


LOG_2PI = 1.8378770664093453


def gaussian_policy(
    controller: Controller,
    action_spec: TensorSpec,
    std: float = 0.5,
    seed: int | None = None,
    observation_key: str = "observation",
    learners: Sequence[int] | None = None,
) -> GaussianPolicy:
    """A Gaussian policy round `controller` for a bounded action spec.

    Args:
        controller: f(s, θ), in units of half the actuator's range.
        action_spec: bounded spec whose last dimension is the action; gives range and units.
        std: initial standard deviation of the exploration, in units of half the actuator's range.
        seed: draws the noise from one stream per learner; TorchRL's global generator if None.
        observation_key: where the observation stands.
        learners: indices of the learners' streams; 0, 1, ... unless told.

    Raises:
        ValueError: `std` not positive, or an action spec without finite bounds.
    """
    if not std > 0:
        raise ValueError(f"std must be positive (in units of half the actuator's range), got {std}")
    low, high = action_bounds(action_spec, controller.action_dim)
    count = controller.batch_shape[0] if controller.batch_shape else 1
    indices = range(count) if learners is None else learners
    noise = None if seed is None else NoiseStream(seed, indices)
    return GaussianPolicy(GaussianHead(controller, low, high, std, observation_key), noise)


def action_bounds(action_spec: TensorSpec, dims: int) -> tuple[Float[Tensor, " A"], Float[Tensor, " A"]]:
    """Lower and upper bounds of a spec whose last dimension is the action, of `dims` entries.

    Raises:
        ValueError: a spec without finite bounds.
    """
    space = action_spec.space
    if not isinstance(space, ContinuousBox) or not bool(torch.isfinite(space.high - space.low).all()):
        raise ValueError(f"the action spec must be bounded on both sides, got {action_spec}")
    return space.low.reshape(-1, dims)[0], space.high.reshape(-1, dims)[0]
