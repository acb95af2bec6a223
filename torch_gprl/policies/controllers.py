"""Deterministic controllers f(s, θ): linear, radial basis functions, multi-layer perceptron.

Each is batched over learners: parameters carry `batch_shape`, and observations [*batch, ..., observation_dim]
map to actions [*batch, ..., action_dim] in units of half the actuator's range (1 is full throttle). They
start at zero action everywhere.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_gprl.policies.streams import learner_generators, stacked_normal


class Controller(nn.Module, ABC):
    """A function from standardised observations to actions, one for each learner.

    Args:
        observation_dim: entries of an observation.
        action_dim: entries of an action.
        batch_shape: () or (learners,).
    """

    observation_loc: Float[Tensor, "*batch D"]
    observation_scale: Float[Tensor, "*batch D"]

    def __init__(self, observation_dim: int, action_dim: int, batch_shape: Sequence[int] = ()) -> None:
        super().__init__()
        if len(batch_shape) > 1:
            raise ValueError(
                f"a controller's batch_shape must be () or (learners,), got {tuple(batch_shape)}"
            )
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.batch_shape = torch.Size(batch_shape)
        self.register_buffer("observation_loc", torch.zeros(*batch_shape, observation_dim))
        self.register_buffer("observation_scale", torch.ones(*batch_shape, observation_dim))

    @abstractmethod
    def act(self, features: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N A"]:
        """Actions at standardised observations [*batch, N, observation_dim]."""

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [*batch, ..., action_dim] at observations [*batch, ..., observation_dim]."""
        lead = observation.shape[:-1]
        flat = observation.reshape(*self.batch_shape, -1, self.observation_dim)
        standard = (flat - self.observation_loc.unsqueeze(-2)) / self.observation_scale.unsqueeze(-2)
        return self.act(standard).reshape(*lead, self.action_dim)

    @torch.no_grad()
    def standardise(self, loc: Float[Tensor, "*#batch D"], scale: Float[Tensor, "*#batch D"]) -> None:
        """Set the mean and the standard deviation by which observations are standardised, [*batch, D]."""
        self.observation_loc.copy_(loc)
        self.observation_scale.copy_(scale)

    def _generators(self, seed: int, first_learner: int) -> list[torch.Generator]:
        count = self.batch_shape[0] if self.batch_shape else 1
        return learner_generators(seed, range(first_learner, first_learner + count), "weights")

    def _normal(self, generators: list[torch.Generator], shape: Sequence[int]) -> Tensor:
        """Standard normal [*batch, *shape], each learner's numbers from its own generator."""
        return stacked_normal(generators, shape).reshape(*self.batch_shape, *shape)


class LinearController(Controller):
    """f(s) = W s + c."""

    def __init__(self, observation_dim: int, action_dim: int, batch_shape: Sequence[int] = ()) -> None:
        super().__init__(observation_dim, action_dim, batch_shape)
        self.weight = nn.Parameter(torch.zeros(*batch_shape, observation_dim, action_dim))
        self.bias = nn.Parameter(torch.zeros(*batch_shape, 1, action_dim))

    def act(self, features: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N A"]:
        """Actions [*batch, N, A]."""
        return features @ self.weight + self.bias


class RBFController(Controller):
    """f(s) = Σ_j w_j φ_j(s), normalised Gaussian bumps φ_j at fixed centres; linear in its parameters.

    Args:
        observation_dim: entries of an observation.
        action_dim: entries of an action.
        batch_shape: () or (learners,).
        centres: number of bumps, drawn from the standard normal of the standardised observations.
        width: standard deviation of a bump, in standard deviations of the observations.
        seed: of the centres, learner by learner.
        first_learner: index of the first learner, whose numbers do not depend on the others.
    """

    centre: Float[Tensor, "*batch C D"]

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        batch_shape: Sequence[int] = (),
        centres: int = 100,
        width: float = 0.5,
        seed: int = 0,
        first_learner: int = 0,
    ) -> None:
        super().__init__(observation_dim, action_dim, batch_shape)
        self.width = width
        generators = self._generators(seed, first_learner)
        self.register_buffer("centre", self._normal(generators, (centres, observation_dim)))
        self.weight = nn.Parameter(torch.zeros(*batch_shape, centres, action_dim))

    def act(self, features: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N A"]:
        """Actions [*batch, N, A]."""
        square = (
            features.square().sum(-1, keepdim=True)
            + self.centre.square().sum(-1).unsqueeze(-2)
            - 2 * features @ self.centre.mT
        )
        return torch.softmax(-0.5 * square / self.width**2, -1) @ self.weight


class MLPController(Controller):
    """Tanh layers with a linear output layer that starts at zero.

    Args:
        observation_dim: entries of an observation.
        action_dim: entries of an action.
        batch_shape: () or (learners,).
        hidden: units of each hidden layer.
        seed: of the initial weights, learner by learner.
        first_learner: index of the first learner, whose numbers do not depend on the others.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        batch_shape: Sequence[int] = (),
        hidden: Sequence[int] = (32, 32),
        seed: int = 0,
        first_learner: int = 0,
    ) -> None:
        super().__init__(observation_dim, action_dim, batch_shape)
        generators = self._generators(seed, first_learner)
        sizes = [observation_dim, *hidden, action_dim]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            last = layer == len(hidden)
            scale = 0.0 if last else fan_in**-0.5
            self.weights.append(nn.Parameter(scale * self._normal(generators, (fan_in, fan_out))))
            self.biases.append(nn.Parameter(torch.zeros(*batch_shape, 1, fan_out)))

    def act(self, features: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N A"]:
        """Actions [*batch, N, A]."""
        *layers, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for hidden_weight, hidden_bias in layers:
            features = torch.tanh(features @ hidden_weight + hidden_bias)
        return features @ weight + bias


class ScaledController(nn.Module):
    """A controller in the actuator's units: 0 is the middle of its range, ±1 are its bounds.

    Args:
        controller: f(s, θ).
        low, high: bounds of the action, [A] each.
    """

    centre: Float[Tensor, " A"]
    half_range: Float[Tensor, " A"]

    def __init__(self, controller: Controller, low: Float[Tensor, " A"], high: Float[Tensor, " A"]) -> None:
        super().__init__()
        self.controller = controller
        self.register_buffer("centre", (high + low) / 2)
        self.register_buffer("half_range", (high - low) / 2)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [*batch, ..., A] at observations [*batch, ..., D]."""
        return self.centre + self.half_range * self.controller(observation)
