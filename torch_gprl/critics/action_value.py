"""The action value Q(s, a) as a Gaussian process: a tensordict module that learns from rollouts.

It owns the one cast between experience (float32) and Gaussian process (float64), the scaling of inputs
x = (s, a) and the standardisation of targets: the process sees inputs of unit spread and targets of zero mean
and unit variance, as its zero-mean unit-amplitude prior assumes.
"""

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_gprl.gp import Posterior, SparseOnlineGP


class GPActionValue(TensorDictModuleBase):
    """Q(s, a) with its uncertainty, one Gaussian process per learner.

    Reads observation and action, writes `state_action_value` and `state_action_value_variance` (of the latent
    value, without noise), each with the trailing 1 of TorchRL. Leading dimensions are those of the process'
    `batch_shape`; all others are points.

    Args:
        gp: process over (observation, action).
        observation_key, action_key: where the inputs stand.
        action_low, action_high: bounds to which actions are clipped before the process sees them, as the
            actuator does, [action_dim]; no clipping unless told.
    """

    input_loc: Float[Tensor, "*batch D"]
    input_scale: Float[Tensor, "*batch D"]
    target_loc: Float[Tensor, "*batch"]
    target_scale: Float[Tensor, "*batch"]
    action_low: Tensor | None
    action_high: Tensor | None

    def __init__(
        self,
        gp: SparseOnlineGP,
        observation_key: str = "observation",
        action_key: str = "action",
        action_low: Tensor | None = None,
        action_high: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = [observation_key, action_key]
        self.out_keys = ["state_action_value", "state_action_value_variance"]
        self.gp = gp
        like, dims = gp.basis, gp.kernel.input_dim
        self.register_buffer("input_loc", like.new_zeros(*gp.batch_shape, dims))
        self.register_buffer("input_scale", like.new_ones(*gp.batch_shape, dims))
        self.register_buffer("target_loc", like.new_zeros(gp.batch_shape))
        self.register_buffer("target_scale", like.new_ones(gp.batch_shape))
        self.register_buffer("action_low", action_low)
        self.register_buffer("action_high", action_high)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write mean and variance of the action value, [*batch, 1] each, in the observation's dtype."""
        observation, action = (tensordict.get(key) for key in self.in_keys)
        posterior = self.value(observation, action)
        for key, tensor in zip(self.out_keys, posterior, strict=True):
            tensordict.set(key, tensor.unsqueeze(-1).to(observation.dtype))
        return tensordict

    def value(self, observation: Tensor, action: Tensor) -> Posterior:
        """Posterior of Q in units of the return, at observations [*batch, ..., D] and actions."""
        posterior = self.gp.posterior(self.inputs(observation, action))
        scale = self.target_scale.unsqueeze(-1)
        mean = self.target_loc.unsqueeze(-1) + scale * posterior.mean
        lead = observation.shape[:-1]
        return Posterior(mean.reshape(lead), (scale.square() * posterior.variance).reshape(lead))

    def mean_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Posterior mean of Q alone [*batch, ...], several times cheaper than `value`."""
        mean = self.gp.mean(self.inputs(observation, action))
        return (self.target_loc.unsqueeze(-1) + self.target_scale.unsqueeze(-1) * mean).reshape(
            observation.shape[:-1]
        )

    def inputs(self, observation: Tensor, action: Tensor) -> Float[Tensor, "*batch N D"]:
        """Scaled inputs of the process [*batch, N, D]: all dimensions beyond the learners become points."""
        if self.action_low is not None:
            action = torch.clamp(action, self.action_low, self.action_high)
        raw = torch.cat([observation, action], -1).to(self.input_loc.dtype)
        raw = raw.reshape(*self.gp.batch_shape, -1, raw.shape[-1])
        return (raw - self.input_loc.unsqueeze(-2)) / self.input_scale.unsqueeze(-2)

    def standard_targets(self, target: Tensor) -> Float[Tensor, "*batch N"]:
        """Targets [*batch, ..., 1] as the process sees them, [*batch, N]."""
        flat = target.to(self.target_loc.dtype).reshape(*self.gp.batch_shape, -1)
        return (flat - self.target_loc.unsqueeze(-1)) / self.target_scale.unsqueeze(-1)

    @torch.no_grad()
    def standardise(self, observation: Tensor, action: Tensor, target: Tensor) -> None:
        """Fix the scaling by a first set of data, learner by learner; forgets what was learned.

        A column, or a set of targets, without spread keeps the scale 1.
        """
        self.gp.reset()
        self.input_loc.zero_()
        self.input_scale.fill_(1)
        inputs = self.inputs(observation, action)
        target = target.to(inputs.dtype).reshape(inputs.shape[:-1])
        for loc, scale, data in (
            (self.input_loc, self.input_scale, inputs),
            (self.target_loc, self.target_scale, target.unsqueeze(-1)),
        ):
            std = data.std(-2, correction=0)
            loc.copy_(data.mean(-2).reshape(loc.shape))
            scale.copy_(torch.where(std > 1e-6, std, 1.0).reshape(scale.shape))

    @torch.no_grad()
    def update(
        self, tensordict: TensorDictBase, target_key: str = "value_target", stamp: int | None = None
    ) -> None:
        """Absorb a rollout or transitions: targets stand under `target_key`, [*batch, ..., 1].

        Args:
            tensordict: experience with observation, action and target.
            target_key: where the target stands.
            stamp: index of the policy update, kept with the basis vectors that this data adds.

        Raises:
            ValueError: NaN or infinite data, or shapes that do not fit; nothing was learned then.
        """
        observation, action = (tensordict.get(key) for key in self.in_keys)
        target = self.standard_targets(tensordict.get(target_key))
        self.gp.update(self.inputs(observation, action), target, stamp=stamp)
