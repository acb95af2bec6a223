"""A neural state value, one network for each learner, all trained side by side: the baseline of the field.

Two tanh layers of 64 units, fitted to returns by Adam on minibatches, as in Schulman et al. (2016),
"High-dimensional continuous control using generalized advantage estimation". Targets are standardised; where
their mean and spread change, the last layer is rescaled so that no value changes (van Hasselt et al., 2016,
"Learning values across many orders of magnitude").
"""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor, nn

from torch_gprl.policies import MLPController

HIDDEN = (64, 64)
FIRST_STEPS, STEPS, MINIBATCH, LEARNING_RATE = 300, 80, 250, 3e-3


class NeuralValue(nn.Module):
    """V(s) in the place of a critic: the same for every action, without uncertainty.

    Args:
        observation_dim: entries of an observation.
        learners: independent networks.
        seed: of the initial weights, learner by learner.
        first_learner: index of the first learner, whose weights do not depend on the others.
    """

    target_loc: Float[Tensor, " learners"]
    target_scale: Float[Tensor, " learners"]

    def __init__(self, observation_dim: int, learners: int, seed: int = 0, first_learner: int = 0) -> None:
        super().__init__()
        self.in_keys = ["observation", "action"]
        self.network = MLPController(observation_dim, 1, (learners,), HIDDEN, seed, first_learner)
        self.register_buffer("target_loc", torch.zeros(learners))
        self.register_buffer("target_scale", torch.ones(learners))

    def mean_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """V(s), whatever the action [learners, ...]."""
        return self.state_value(observation)

    def mean_state_value(self, observation: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
        """V(s), whatever the policy's mean and standard deviation [learners, ...]."""
        return self.state_value(observation)

    def state_value(
        self, observation: Float[Tensor, "learners *points D"]
    ) -> Float[Tensor, "learners *points"]:
        """V(s) in units of the return, in double precision."""
        value = self.network(observation.to(self.target_loc.dtype)).flatten(1).double()
        value = self.target_loc.unsqueeze(-1) + self.target_scale.unsqueeze(-1) * value
        return value.reshape(observation.shape[:-1])

    @torch.no_grad()
    def standardise(
        self, observation: Float[Tensor, "learners N D"], target: Float[Tensor, "learners N"]
    ) -> None:
        """Set the scales of inputs and targets by a first set of data."""
        self.network.standardise(observation.mean(1), _spread(observation))
        self.target_loc.copy_(target.mean(1))
        self.target_scale.copy_(_spread(target))

    @torch.no_grad()
    def rescale_targets(self, target: Float[Tensor, "learners N"]) -> None:
        """Set the scale of targets by these; values stay as they are."""
        loc, scale = target.mean(1), _spread(target)
        weight, bias = self.network.weights[-1], self.network.biases[-1]
        ratio, shift = self.target_scale / scale, (self.target_loc - loc) / scale
        weight.mul_(ratio[:, None, None])
        bias.mul_(ratio[:, None, None]).add_(shift[:, None, None])
        self.target_loc.copy_(loc)
        self.target_scale.copy_(scale)


def _spread(data: Tensor) -> Tensor:
    """Standard deviation over dimension 1; 1 where there is none."""
    std = data.std(1)
    return torch.where(std > 1e-6, std, 1.0)


class NeuralTeacher:
    """Fits neural values to returns, rollout by rollout; in the place of `Teacher`.

    Args:
        critic: what is taught.
    """

    experience = None  # each rollout serves once

    def __init__(self, critic: NeuralValue) -> None:
        self.critic = critic
        self.optimiser = torch.optim.Adam(critic.parameters(), lr=LEARNING_RATE)

    def teach(self, rollout: TensorDictBase, update: int) -> None:
        """Fit a rollout that carries `value_target`, [learners, envs, T], made at policy update `update`."""
        dtype = self.critic.target_loc.dtype
        observation = rollout.get("observation").flatten(1, 2).to(dtype)
        target = rollout.get("value_target").flatten(1).to(dtype)
        if update == 0:
            self.critic.standardise(observation, target)
        else:
            self.critic.rescale_targets(target)
        scaled = (target - self.critic.target_loc[:, None]) / self.critic.target_scale[:, None]
        draw = torch.Generator().manual_seed(update)  # one order for all learners, however many they are
        for _ in range(STEPS if update else FIRST_STEPS):
            chosen = torch.randint(target.shape[1], (MINIBATCH,), generator=draw).to(target.device)
            error = self.critic.network(observation[:, chosen]).squeeze(-1) - scaled[:, chosen]
            self.optimiser.zero_grad()
            error.square().mean(1).sum().backward()
            self.optimiser.step()

    def figures(self) -> dict[str, Tensor]:
        """Nothing beyond what the learner itself reports."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimiser."""
        return {"critic": self.critic.state_dict(), "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
