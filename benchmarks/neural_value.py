"""Neural state values, one network for each batch, all trained side by side: the usual baseline of the field.

Two tanh layers of 64 units, fitted to discounted returns by Adam on minibatches; where an episode is cut, the
return goes on with the network's own value, in a second round of fitting.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.gradient_data import Batches
from torch_gprl.critics import k_step_returns
from torch_gprl.policies import MLPController

HIDDEN = (64, 64)
ROUNDS, UPDATES, MINIBATCH, LEARNING_RATE = 2, 300, 250, 3e-3


class NeuralValue:
    """V(s) of each learner.

    Args:
        batches: data to fit, one batch for each learner.
        discount: γ.
    """

    def __init__(self, batches: Batches, discount: float) -> None:
        data = batches.data
        learners = data.shape[0]
        observation = data["observation"].flatten(1, 2)
        reward, done, terminated = (data["next", key].squeeze(-1) for key in ("reward", "done", "terminated"))
        self.network = MLPController(observation.shape[-1], 1, (learners,), HIDDEN)
        std = observation.std(1)
        self.network.standardise(observation.mean(1), torch.where(std > 1e-6, std, 1.0))
        self.loc, self.scale = torch.zeros(learners, 1), torch.ones(learners, 1)
        beyond = torch.zeros_like(reward)
        for round_ in range(ROUNDS):
            target = k_step_returns(reward, beyond, done, discount, reward.shape[-1]).flatten(1)
            if round_ == 0:
                self.loc, self.scale = target.mean(1, keepdim=True), target.std(1, keepdim=True)
            self._fit(observation, (target - self.loc) / self.scale)
            beyond = torch.where(terminated, 0.0, self(data["next", "observation"]).to(reward.dtype))

    def _fit(self, observation: Tensor, target: Tensor) -> None:
        optimiser = torch.optim.Adam(self.network.parameters(), lr=LEARNING_RATE)
        for _ in range(UPDATES):
            chosen = torch.randint(target.shape[1], (MINIBATCH,))
            error = self.network(observation[:, chosen]).squeeze(-1) - target[:, chosen]
            optimiser.zero_grad()
            error.square().mean(1).sum().backward()
            optimiser.step()

    @torch.no_grad()
    def __call__(
        self, observation: Float[Tensor, "learners episodes steps D"]
    ) -> Float[Tensor, "learners episodes steps"]:
        """V in units of the return."""
        value = self.network(observation).squeeze(-1)
        return (self.loc.unsqueeze(-1) + self.scale.unsqueeze(-1) * value).double()
