"""The Gaussian-process critic as a TorchRL value estimator: drops into TorchRL's losses and into ours.

    estimator = GPValueEstimator(critic, policy, discount=0.98)
    loss = ClipPPOLoss(policy, critic_network=GPStateValue(critic, policy), critic_coeff=None)
    loss.make_value_estimator(estimator)

It writes the weights of the scores, by any of the names in `estimators`, and the targets for the critic.
"""

# TorchRL declares these members as its own estimators need them:
# pyright: reportIncompatibleVariableOverride=false

from dataclasses import dataclass
from typing import Protocol, get_args, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.value import ValueEstimatorBase

from torch_gprl.critics.estimators import ESTIMATORS, EstimatorName, Evaluation
from torch_gprl.critics.gaussian_actions import action_moments


@runtime_checkable
class Critic(Protocol):
    """What the estimator asks of a critic: `GPActionValue` has it, and so may others."""

    in_keys: list

    def mean_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q(s, a) in units of the return [*batch, ...]."""
        ...

    def mean_state_value(self, observation: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
        """V(s), for actions N(loc, scale²), in units of the return [*batch, ...]."""
        ...


class GPStateValue(TensorDictModuleBase):
    """V(s) = E_a Q(s, a) under a Gaussian policy, in closed form; writes `state_value`.

    Args:
        critic: the action value.
        policy: Gaussian policy over whose actions to average; not trained by this module.
    """

    critic: Critic
    policy: ProbabilisticTensorDictSequential

    def __init__(self, critic: Critic, policy: ProbabilisticTensorDictSequential) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [str(critic.in_keys[0])], ["state_value"]
        _refer(self, critic=critic, policy=policy)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write V(s), [*batch, 1], in the observation's dtype."""
        observation = tensordict.get(self.in_keys[0])
        value = self.critic.mean_state_value(observation, *action_moments(self.policy, tensordict))
        return tensordict.set(self.out_keys[0], value.unsqueeze(-1).to(observation.dtype))


class GPValueEstimator(ValueEstimatorBase):
    """Writes `advantage` (weights of the scores), `value_target` (returns for the critic), `state_value`.

    Data are [*batch, ..., T], the batch that of the critic and time last, from the collector as they are. No
    gradient flows. What the critic says is said in float64, whatever the data, and written in their dtype.

    Args:
        critic: the action value.
        policy: the Gaussian policy that is trained.
        discount: γ per step.
        estimator: a name of `estimators.ESTIMATORS`.
        horizon: real rewards before the critic's value takes over, in the k-step weights and in
            `value_target`; 0 weighs by the critic's Q(s, a) itself, with a target of one reward.
        trace: λ of the estimator "generalised".
        device: TorchRL's losses pass it; the data's own device counts.

    Raises:
        ValueError: an estimator that does not exist, or a horizon below 0.
    """

    @dataclass
    class _AcceptedKeys(ValueEstimatorBase._AcceptedKeys):
        # TorchRL looks for names among a class's own: inherited ones do not count
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        sample_log_prob: NestedKey | None = None

    default_keys = _AcceptedKeys
    critic: Critic
    policy: ProbabilisticTensorDictSequential

    def __init__(
        self,
        critic: Critic,
        policy: ProbabilisticTensorDictSequential,
        discount: float,
        estimator: EstimatorName = "k-step-baseline",
        horizon: int = 1,
        trace: float = 0.95,
        *,
        device: torch.device | None = None,
    ) -> None:
        if estimator not in get_args(EstimatorName):
            raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
        if horizon < 0:
            raise ValueError(f"horizon must be at least 0 steps, got {horizon}")
        value = GPStateValue(critic, policy)
        super().__init__(value_network=value, device=device)  # pyright: ignore[reportArgumentType]
        _refer(self, critic=critic, policy=policy)
        self.discount, self.estimator, self.horizon, self.trace = discount, estimator, horizon, trace

    @torch.no_grad()
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
    ) -> TensorDictBase:
        """Write `advantage`, `value_target` and `state_value`, [*batch, ..., T, 1] each.

        Args:
            tensordict: rollout with observation, action, and under "next" observation, reward, done and
                terminated.
            params: of a value network; a Gaussian process has none.
            target_params: likewise.
        """
        return self.write(tensordict, self.evaluate(tensordict))

    def write(self, tensordict: TensorDictBase, seen: Evaluation) -> TensorDictBase:
        """`forward`, given what `evaluate` has said of the rollout."""
        target = seen.to_go if self.horizon >= seen.reward.shape[-1] else seen.bootstrapped(seen.beyond)
        written = {"advantage": ESTIMATORS[self.estimator](seen), "value_target": target, "value": seen.value}
        for name, column in written.items():
            dtype = tensordict.get(("next", self.tensor_keys.reward)).dtype
            tensordict.set(getattr(self.tensor_keys, name), column.unsqueeze(-1).to(dtype))
        return tensordict

    @torch.no_grad()
    def evaluate(self, tensordict: TensorDictBase) -> Evaluation:
        """What the critic and the policy say of a rollout, in float64."""
        critic, policy, keys = self.critic, self.policy, self.tensor_keys
        observation, action = (tensordict.get(key) for key in critic.in_keys)
        following = tensordict.get("next")
        loc, scale = action_moments(policy, tensordict)
        taken = critic.mean_value(observation, action)
        reward, done, terminated = (
            following.get(key).squeeze(-1) for key in (keys.reward, keys.done, keys.terminated)
        )
        return Evaluation(
            reward=reward.to(taken.dtype),
            done=done,
            terminated=terminated,
            taken=taken,
            value=critic.mean_state_value(observation, loc, scale),
            next_value=critic.mean_state_value(
                following.get(critic.in_keys[0]), *action_moments(policy, following)
            ),
            square_score=_square_score((action - loc) / scale, scale).to(taken.dtype),
            discount=self.discount,
            horizon=self.horizon,
            trace=self.trace,
        )


def _refer(module: TensorDictModuleBase, **others: Critic | TensorDictModuleBase) -> None:
    """Know other modules without owning them: the learner saves the critic, the loss trains the policy."""
    for name, other in others.items():
        object.__setattr__(module, name, other)


def _square_score(deviation: Tensor, scale: Tensor) -> Tensor:
    """|∂ log N(a; μ, σ²)/∂μ|² + |∂/∂ log σ|², with the deviation (a − μ)/σ: [..., T]."""
    return ((deviation / scale).square() + (deviation.square() - 1).square()).sum(-1)
