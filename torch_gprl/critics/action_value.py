"""The action value Q(s, a) as a Gaussian process: a tensordict module that learns from rollouts.

It owns the one cast between experience (float32) and Gaussian process (float64), the scaling of inputs
x = (s, a) and the standardisation of targets: the process sees inputs of unit spread and targets of zero mean
and unit variance, as its zero-mean unit-amplitude prior assumes.

It learns from returns (regression), or from rewards as temporal differences, r = Q(x) − γ E_a' Q(s', a') + n:
Engel, Mannor and Meir (2005), "Reinforcement learning with Gaussian processes", with the average over the
policy in closed form.
"""

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor

from torch_gprl.critics.gaussian_actions import action_moments, clipped_moments
from torch_gprl.gp import Posterior, SparseOnlineGP
from torch_gprl.gp.prescribed import adopt_basis, observe
from torch_gprl.kernels import GaussianInputs

BLOCK = 1024  # transitions that `resolve` takes at a time: larger matrices leave the processor's cache


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

    # ---------------------------------------------------------------- values

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write mean and variance of the action value, [*batch, 1] each, in the observation's dtype."""
        observation, action = (tensordict.get(key) for key in self.in_keys)
        posterior = self.value(observation, action)
        for key, tensor in zip(self.out_keys, posterior, strict=True):
            tensordict.set(key, tensor.unsqueeze(-1).to(observation.dtype))
        return tensordict

    def value(self, observation: Tensor, action: Tensor) -> Posterior:
        """Posterior of Q in units of the return, at observations [*batch, ..., D] and actions."""
        return self._in_units(self.gp.posterior(self.inputs(observation, action)), observation)

    def basis_points(self, learner: int) -> Tensor:
        """A learner's basis vectors [size, D] in their own units: observations, then actions."""
        used = self.gp.basis[learner, : int(self.gp.size[learner])]
        return used * self.input_scale[learner] + self.input_loc[learner]

    def mean_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Posterior mean of Q alone [*batch, ...], several times cheaper than `value`."""
        return self._mean_in_units(self.inputs(observation, action), observation)

    def state_value(self, observation: Tensor, loc: Tensor, scale: Tensor) -> Posterior:
        """Posterior of V(s) = E_a Q(s, a) for actions N(loc, scale²), in closed form.

        Args:
            observation: [*batch, ..., D].
            loc: mean of the action, in its units, [*batch, ..., A].
            scale: standard deviation of the action, [*batch, ..., A].
        """
        return self._in_units(self.gp.posterior(self.averaged_inputs(observation, loc, scale)), observation)

    def mean_state_value(self, observation: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
        """Posterior mean of V(s) alone [*batch, ...]: its gradient in loc and scale is the all-action one."""
        return self._mean_in_units(self.averaged_inputs(observation, loc, scale), observation)

    def _in_units(self, posterior: Posterior, observation: Tensor) -> Posterior:
        loc, scale = self.target_loc.unsqueeze(-1), self.target_scale.unsqueeze(-1)
        lead = observation.shape[:-1]
        variance = scale.square() * posterior.variance
        return Posterior((loc + scale * posterior.mean).reshape(lead), variance.reshape(lead))

    def _mean_in_units(self, inputs: Tensor | GaussianInputs, observation: Tensor) -> Tensor:
        mean = self.target_loc.unsqueeze(-1) + self.target_scale.unsqueeze(-1) * self.gp.mean(inputs)
        return mean.reshape(observation.shape[:-1])

    # ---------------------------------------------------------------- scaling

    def inputs(self, observation: Tensor, action: Tensor) -> Float[Tensor, "*batch N D"]:
        """Scaled inputs of the process [*batch, N, D]: all dimensions beyond the learners become points."""
        if self.action_low is not None:
            action = torch.clamp(action, self.action_low, self.action_high)
        raw = self._points(torch.cat([observation, action], -1))
        return (raw - self.input_loc.unsqueeze(-2)) / self.input_scale.unsqueeze(-2)

    def averaged_inputs(self, observation: Tensor, loc: Tensor, scale: Tensor) -> GaussianInputs:
        """Scaled inputs [*batch, N, D] whose action columns are Gaussian: N(loc, scale²) as clipped.

        The clipped action is taken as the Gaussian of the same mean and variance.
        """
        loc, scale = loc.to(self.input_loc.dtype), scale.to(self.input_loc.dtype)
        variance = scale.square()
        if self.action_low is not None and self.action_high is not None:
            loc, variance = clipped_moments(loc, scale, self.action_low, self.action_high)
        dims, actions = self.input_loc.shape[-1], loc.shape[-1]
        unit = self.input_scale[..., None, dims - actions :].square()
        columns = tuple(range(dims - actions, dims))
        return GaussianInputs(self.inputs(observation, loc), self._points(variance) / unit, columns)

    def _points(self, raw: Tensor) -> Tensor:
        """[*batch, ..., D] as [*batch, N, D] in the process' dtype."""
        return raw.to(self.input_loc.dtype).reshape(*self.gp.batch_shape, -1, raw.shape[-1])

    def standard_targets(self, target: Tensor, discount: float | Tensor = 0.0) -> Float[Tensor, "*batch N"]:
        """Targets [*batch, ..., 1] as the process sees them, [*batch, N].

        Args:
            target: values, or temporal differences Q(x) − γ Q(x').
            discount: γ, a number or [*batch, N]; 0 for values.
        """
        flat = target.to(self.target_loc.dtype).reshape(*self.gp.batch_shape, -1)
        # Q = loc + scale · f, hence Q − γQ' = (1 − γ) loc + scale · (f − γf')
        return (flat - (1 - discount) * self.target_loc.unsqueeze(-1)) / self.target_scale.unsqueeze(-1)

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

    # ---------------------------------------------------------------- learning

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

    @torch.no_grad()
    def update_differences(
        self,
        tensordict: TensorDictBase,
        policy: ProbabilisticTensorDictSequential,
        discount: float,
        stamp: int | None = None,
    ) -> None:
        """Absorb transitions as temporal differences, r = Q(s, a) − γ E_a' Q(s', a') + noise.

        The average is over the actions of `policy`, whoever made the transitions: off-policy data serve too.
        Time limits bootstrap, terminal states do not.

        Args:
            tensordict: transitions [*batch, ...] with observation, action, and under "next" observation,
                reward and terminated.
            policy: Gaussian policy whose value is learned.
            discount: γ per step.
            stamp: index of the policy update, kept with the basis vectors that this data adds.

        Raises:
            ValueError: NaN or infinite data, or shapes that do not fit; nothing was learned then.
        """
        inputs, averaged, rate, target = self._differences(tensordict, policy, discount)
        self.gp.update(inputs, target, stamp=stamp, next_inputs=averaged, discount=rate)

    @torch.no_grad()
    def cover(self, observation: Tensor, action: Tensor, lengthscale: Float[Tensor, " D"]) -> None:
        """Forget what was learned, and spread the basis evenly over this experience.

        Args:
            observation: [*batch, ..., S].
            action: [*batch, ..., A].
            lengthscale: units in which distances count, by column of (observation, action), in those of the
                scaled inputs.
        """
        adopt_basis(self.gp, self.inputs(observation, action), lengthscale)

    @torch.no_grad()
    def resolve(
        self, tensordict: TensorDictBase, policy: ProbabilisticTensorDictSequential, discount: float
    ) -> None:
        """Solve the temporal differences of all given transitions at once, under today's policy.

        The basis stays, and should cover the transitions (see `cover`): what it misses of them counts as
        explained. What was learned on it is forgotten: nothing of an older policy's values is left.

        Args:
            tensordict: transitions [*batch, ...], such as a replay buffer's; see `update_differences`.
            policy: Gaussian policy whose value is learned.
            discount: γ per step.
        """
        gp = self.gp
        gp.refresh()
        gp.forget()
        rows = int(gp.size.max())
        basis, mask = gp.basis[..., :rows, :], gp.mask[..., None, :rows]
        flat = tensordict.reshape(*gp.batch_shape, -1)
        for block in flat.split(BLOCK, len(gp.batch_shape)):
            inputs, averaged, rate, target = self._differences(block, policy, discount)
            # Q(s, a) − γ E_a' Q(s', a') in the weights of the basis
            rate = rate.unsqueeze(-1)
            ahead = torch.where(rate > 0, rate * gp.kernel.expected(averaged, basis), 0.0)
            observe(gp, (gp.kernel(inputs, basis) - ahead) * mask, target)

    def _differences(
        self, tensordict: TensorDictBase, policy: ProbabilisticTensorDictSequential, discount: float
    ) -> tuple[Tensor, GaussianInputs, Tensor, Tensor]:
        """Inputs x, next inputs x' with the policy's actions, γ (0 before a terminal state), and targets."""
        observation, action = (tensordict.get(key) for key in self.in_keys)
        following = tensordict.get("next")
        loc, scale = action_moments(policy, following)
        rate = discount * ~following.get("terminated").reshape(*self.gp.batch_shape, -1)
        target = self.standard_targets(following.get("reward"), rate)
        averaged = self.averaged_inputs(following.get(self.in_keys[0]), loc, scale)
        return self.inputs(observation, action), averaged, rate, target
