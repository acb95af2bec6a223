"""The all-action policy gradient: no sampled action, no variance from it.

Ciosek and Whiteson (2018), "Expected policy gradients": E_a[∇ log π(a|s) Q(s, a)] = ∇_θ E_{a~π_θ} Q(s, a),
and the average has a closed form for a Gaussian process and a Gaussian policy. Autograd does the rest.
"""

# TorchRL declares these members as its own losses need them, not as its documentation tells users to:
# pyright: reportIncompatibleVariableOverride=false, reportIncompatibleMethodOverride=false

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torch_gprl.critics import GPActionValue, action_moments


class AllActionLoss(LossModule):
    """−E_a Q(s, a), averaged over each learner's own states and summed over learners.

    Added to `PolicyGradientLoss` with weights G − Q(s, a), the two make an unbiased gradient whose sampled
    part is only what the critic does not know. The policy's own parameters are trained (no functional
    copies); the critic is not.

    Args:
        actor_network: Gaussian policy, writes `loc` and `scale`.
        critic: the action value.
        learners: whether the first dimension of the data counts independent learners.
    """

    @dataclass
    class _AcceptedKeys:
        state_weight: NestedKey = "state_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    critic: GPActionValue

    def __init__(
        self, actor_network: ProbabilisticTensorDictSequential, critic: GPActionValue, learners: bool = True
    ) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")
        object.__setattr__(self, "critic", critic)  # neither trained nor saved with the loss
        self.learners = learners
        self.out_keys = ["loss_all_action"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the data; the weight of a state is 1 where there is none."""
        return [*self.actor_network.in_keys, self.critic.in_keys[0]]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """`loss_all_action`, a scalar, of states [learners, ..., T]."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            loc, scale = action_moments(self.actor_network, tensordict)
        loss = -self.critic.mean_state_value(tensordict.get(self.critic.in_keys[0]), loc, scale)
        weight = tensordict.get(self.tensor_keys.state_weight, None)
        if weight is not None:
            loss = loss * weight.squeeze(-1)
        total = loss.flatten(1).mean(1).sum() if self.learners else loss.mean()
        return TensorDict({"loss_all_action": total}, [])

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """There is no value estimator: the critic itself is asked."""
