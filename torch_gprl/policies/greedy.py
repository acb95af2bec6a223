"""The greedy policy of an action value, argmax_a Q(s, a), and the plain ways to stray from it.

    a = clip(argmax_a Q(s, a) + σ ε)    with probability 1 − ε₀
    a uniform in the box of actions     with probability ε₀

TorchRL's `EGreedyModule` is for discrete actions, and its noise is shared by all learners; here each has its
own stream.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.policies.gaussian import explores
from torch_gprl.policies.streams import NoiseStream


class GreedyPolicy(TensorDictModuleBase):
    """The best action of a critic, with ε-greedy and Gaussian exploration round it.

    Reads `observation` [learners, ..., S] and writes `action`; without noise under TorchRL's
    `ExplorationType.DETERMINISTIC`.

    Args:
        maximiser: of the critic.
        std: σ, standard deviation of the noise, in halves of the actuator's range.
        epsilon: ε₀, probability of an action uniform in the box.
        seed: of the noise.
        learners: indices of the learners' streams.

    Attributes:
        epsilon: may be changed at any time.
    """

    def __init__(
        self,
        maximiser: ActionMaximiser,
        std: float = 0.1,
        epsilon: float = 0.0,
        seed: int = 0,
        learners: Sequence[int] = (0,),
    ) -> None:
        super().__init__()
        observation_key, action_key = map(str, maximiser.critic.in_keys)
        self.in_keys, self.out_keys = [observation_key], [action_key]
        self.maximiser, self.std, self.epsilon = maximiser, std, epsilon
        self.noise = NoiseStream(seed, learners)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        observation = tensordict.get(self.in_keys[0])
        action = self._explored(observation) if explores() else self.maximiser(observation).action
        return tensordict.set(self.out_keys[0], action.to(observation.dtype))

    def _explored(self, observation: Tensor) -> Tensor:
        low, high = self.maximiser.low, self.maximiser.high
        dims = len(low)
        # one draw serves all: the noise, the uniform action, and the coin that chooses between them
        draw = self.noise.draw(low.new_empty(*observation.shape[:-1], 2 * dims + 1))
        share = torch.special.ndtr(draw[..., dims:])  # uniform in [0, 1]
        uniform = low + (high - low) * share[..., :dims]
        if self.epsilon >= 1:
            return uniform
        near = self.maximiser(observation).action + self.std * (high - low) / 2 * draw[..., :dims]
        return torch.where(share[..., dims:] < self.epsilon, uniform, torch.clamp(near, low, high))
