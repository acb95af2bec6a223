"""The likelihood-ratio policy gradient as a loss (the thesis' equations (.4) and (.7)).

∇J = E[Σ_t ∇ log π(a_t|s_t) w_t], with the weights w_t ("advantage") computed beforehand and held constant.
"""

# TorchRL declares these members as its own losses need them, not as its documentation tells users to:
# pyright: reportIncompatibleVariableOverride=false, reportIncompatibleMethodOverride=false

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule


class PolicyGradientLoss(LossModule):
    """−log π(a|s) · advantage, averaged over each learner's own samples and summed over learners.

    The sum keeps learners apart: the gradient of one learner's parameters is that of its own mean, however
    many learn beside it. The policy's own parameters are trained (no functional copies).

    Args:
        actor_network: policy with `get_dist`.
        learners: whether the first dimension of the data counts independent learners.
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = "advantage"
        action: NestedKey = "action"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(self, actor_network: ProbabilisticTensorDictSequential, learners: bool = True) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")
        self.learners = learners
        self.out_keys = ["loss_objective"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the data."""
        return [*self.actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.advantage]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """`loss_objective`, a scalar, of a rollout [learners, ..., T] with action and advantage [..., 1]."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            distribution = self.actor_network.get_dist(tensordict)
        log_prob = distribution.log_prob(tensordict.get(self.tensor_keys.action))
        advantage = tensordict.get(self.tensor_keys.advantage).squeeze(-1).detach().to(log_prob.dtype)
        loss = -(log_prob * advantage)
        total = loss.flatten(1).mean(1).sum() if self.learners else loss.mean()
        return TensorDict({"loss_objective": total}, [])

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """There is no value estimator: advantages come with the data."""
