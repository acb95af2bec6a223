"""REINFORCE with a Gaussian-process critic: the thesis' Claim 1 as a loop.

One update: collect a rollout, weigh its actions by (.7) with the critic as it stood before, step the policy,
teach the critic. All learners at once, each on its own experience.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, RewardSum, TransformedEnv

from torch_gprl.critics import GPActionValue, k_step_returns
from torch_gprl.gp import SparseOnlineGP, fit_hyperparameters
from torch_gprl.kernels import SquaredExponential
from torch_gprl.objectives import PolicyGradientLoss, natural_step
from torch_gprl.policies import Controller, LinearController, MLPController, RBFController, gaussian_policy

FIT_POINTS = 160  # points of a rollout that a fit of hyper-parameters sees; its cost is cubic in them
FIRST_FIT, LATER_FITS = 50, 20  # steps of the optimiser: later fits start from the last
FISHER_EVERY = 4  # one step in four of a rollout enters the Fisher matrix
FIRST_NOISE = 0.05  # noise variance of standardised targets before the first fit

ControllerForm = Literal["linear", "rbf", "mlp"]
Optimiser = Literal["natural", "adam"]


@dataclass(frozen=True)
class PolicyGradientConfig:
    """Policy gradients with a Gaussian-process critic."""

    total_frames: int = 240_000  # environment steps per learner, over all its environments
    rollout_steps: int = 200  # steps of each environment between two policy updates
    discount: float = 0.98  # γ per environment step, from 0 to 1
    horizon: int = 200  # real rewards before the critic's value takes over in (.7); 0 is the critic alone
    baseline: bool = True  # subtract Q(s, f(s)), the critic's value of the controller's own action
    controller: ControllerForm = "mlp"  # form of the controller f(s)
    std: float = 0.5  # initial exploration standard deviation, in halves of the actuator's range
    optimiser: Optimiser = "natural"  # natural gradient in a trust region, or Adam
    trust_region: float = 0.02  # KL divergence of the first natural step, nats; falls linearly to 0
    learning_rate: float = 0.01  # of Adam; falls linearly to 0
    budget: int = 150  # basis vectors of the critic
    novelty_threshold: float = 0.3  # novelty that makes a point a basis vector, in noise variances
    renew_every: int = 20  # policy updates between two renewals of the critic, which forget older data

    def __post_init__(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: naming the field, its value and what would be valid.
        """
        for name in ("total_frames", "rollout_steps", "budget", "renew_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("std", "trust_region", "learning_rate"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.discount <= 1:
            raise ValueError(f"discount must lie between 0 and 1, got {self.discount}")
        if self.horizon < 0:
            raise ValueError(f"horizon must be at least 0 steps, got {self.horizon}")
        for name, choices in (("controller", get_args(ControllerForm)), ("optimiser", get_args(Optimiser))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")


class PolicyGradient:
    """Trains Gaussian policies, one for each learner of `env`, with a Gaussian process for the action value.

    Args:
        env: environment of batch [learners, environments] with a bounded action.
        config: numbers of the algorithm.
        seed: of initial weights and of exploration, learner by learner: learner i of many learns what
            learner i alone would, if the environment's random numbers keep learners apart too.
        first_learner: index of the first learner in those streams.
    """

    def __init__(
        self, env: EnvBase, config: PolicyGradientConfig, seed: int = 0, first_learner: int = 0
    ) -> None:
        if len(env.batch_size) != 2:
            raise ValueError(
                f"the environment's batch must be [learners, environments], got {tuple(env.batch_size)}"
            )
        self.env, self.config = env, config
        self.learners, num_envs = env.batch_size
        indices = range(first_learner, first_learner + self.learners)
        dims = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
        controller = _controller(config.controller, *dims, indices, seed).to(
            env.observation_spec["observation"].dtype
        )
        self.policy = gaussian_policy(controller, env.action_spec, config.std, seed, learners=indices).to(
            env.device
        )
        self.critic = self._make_critic(sum(dims)).to(env.device)
        self.loss = PolicyGradientLoss(self.policy)
        self.adam = torch.optim.Adam(self.policy.parameters(), lr=config.learning_rate)
        self.frames_per_update = num_envs * config.rollout_steps
        self.total_updates = -(-config.total_frames // self.frames_per_update)
        self.updates = 0
        self._last_return = torch.full((self.learners,), torch.nan, device=env.device)

    def _make_critic(self, dims: int) -> GPActionValue:
        config, head = self.config, self.policy.head
        kernel = SquaredExponential(dims, batch_shape=(self.learners,))
        gp = SparseOnlineGP(kernel, config.budget, FIRST_NOISE, config.novelty_threshold)
        low, high = head.centre - head.half_range, head.centre + head.half_range
        return GPActionValue(gp, action_low=low, action_high=high)

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        return self.updates * self.frames_per_update

    def train(self) -> Iterator[dict[str, Tensor]]:
        """Run the remaining updates; yields figures of each, [learners] every one."""
        collector = self._collector()
        try:
            for rollout in collector:
                if self.updates == 0:
                    self._standardise(rollout)
                self._weigh(rollout)
                if self.updates == 0:  # an empty critic is no baseline: the first rollout serves as its own
                    self._teach(rollout)
                    self._weigh(rollout)
                gradient_norm = self._step_policy(rollout)
                if self.updates > 0:
                    self._teach(rollout)
                self.updates += 1
                yield self._figures(rollout, gradient_norm)
        finally:
            collector.shutdown(close_env=False)

    def _collector(self) -> Collector:
        per_update = self.learners * self.frames_per_update
        return Collector(
            TransformedEnv(self.env, RewardSum()),
            self.policy,
            frames_per_batch=per_update,
            total_frames=per_update * (self.total_updates - self.updates),
            auto_register_policy_transforms=False,
        )

    @torch.no_grad()
    def _standardise(self, rollout: TensorDictBase) -> None:
        """Scale the controller's inputs by the first rollout; until then it acts zero everywhere."""
        observation = rollout.get("observation").flatten(1, 2)
        std = observation.std(1)
        self.policy.head.controller.standardise(observation.mean(1), torch.where(std > 1e-6, std, 1.0))

    @torch.no_grad()
    def _weigh(self, rollout: TensorDictBase) -> None:
        """Write `value_target`, the returns of (.7), and `advantage`, the weights w_t of the scores."""
        observation, action = rollout.get("observation"), rollout.get("action")
        done, terminated = (rollout.get(("next", key)).squeeze(-1) for key in ("done", "terminated"))
        taken = self.critic.mean_value(observation, action)  # Q(s_t, a_t)
        ending = self._state_value(rollout.get(("next", "observation")))
        last = done.clone()
        last[..., -1] = True
        following = torch.where(last, ending, torch.cat([taken[..., 1:], ending[..., -1:]], -1))
        following = torch.where(
            terminated, 0.0, following
        )  # nothing follows a terminal state; a time limit is none
        reward = rollout.get(("next", "reward")).squeeze(-1).to(taken.dtype)
        target = k_step_returns(reward, following, done, self.config.discount, max(self.config.horizon, 1))
        weight = target if self.config.horizon > 0 else taken
        if self.config.baseline:
            value = self._state_value(observation)
            weight = weight - value
            rollout.set("state_value", value.unsqueeze(-1))
        rollout.set("value_target", target.unsqueeze(-1)).set("advantage", weight.unsqueeze(-1))

    def _state_value(self, observation: Tensor) -> Tensor:
        """Q(s, f(s)) [learners, ...]."""
        return self.critic.mean_value(observation, self.policy.head.parameters_at(observation)[0])

    def _step_policy(self, rollout: TensorDictBase) -> Tensor:
        """One step along the gradient of all learners; returns the norm of each one's gradient."""
        parameters = list(self.policy.parameters())
        self.adam.zero_grad()
        self.loss(rollout)["loss_objective"].backward()
        norm = torch.stack([p.grad.flatten(1).norm(dim=1) for p in parameters if p.grad is not None]).norm(
            dim=0
        )
        left = 1 - self.updates / self.total_updates
        if self.config.optimiser == "adam":
            self.adam.param_groups[0]["lr"] = self.config.learning_rate * left
            self.adam.step()
        else:
            natural_step(parameters, self._divergence(rollout), self.config.trust_region * left)
        return norm

    def _teach(self, rollout: TensorDictBase) -> None:
        """Let the critic absorb the rollout; renew it at updates 0, 1, 2, 4, ... and every `renew_every`."""
        young = self.updates & (self.updates - 1) == 0  # a power of two: values change fast at first
        if self.updates % self.config.renew_every == 0 or (young and self.updates < self.config.renew_every):
            self._renew(rollout)
        self.critic.update(rollout, stamp=self.updates)

    def _renew(self, rollout: TensorDictBase) -> None:
        """Forget, and set scaling and hyper-parameters by this rollout."""
        data = rollout.get("observation"), rollout.get("action")
        self.critic.standardise(*data, rollout.get("value_target"))
        inputs, targets = self.critic.inputs(*data), self.critic.standard_targets(rollout.get("value_target"))
        chosen = torch.linspace(0, inputs.shape[1] - 1, min(FIT_POINTS, inputs.shape[1])).long()
        steps = FIRST_FIT if self.updates == 0 else LATER_FITS
        fit_hyperparameters(self.critic.gp, inputs[:, chosen], targets[:, chosen], steps)

    def _divergence(self, rollout: TensorDictBase) -> Callable[[], Tensor]:
        """Mean KL(π_now ‖ π_θ) over states of the rollout [learners], a function of the parameters θ."""
        observation = rollout.get("observation")[:, :, ::FISHER_EVERY]
        head = self.policy.head
        with torch.no_grad():
            loc, scale = head.parameters_at(observation)

        def divergence() -> Tensor:
            new_loc, new_scale = head.parameters_at(observation)
            ratio = (scale.square() + (loc - new_loc).square()) / (2 * new_scale.square())
            return (new_scale.log() - scale.log() + ratio - 0.5).sum(-1).flatten(1).mean(1)

        return divergence

    @torch.no_grad()
    def _figures(self, rollout: TensorDictBase, gradient_norm: Tensor) -> dict[str, Tensor]:
        ended = rollout.get(("next", "done")).squeeze(-1).flatten(1)
        returns = rollout.get(("next", "episode_reward")).squeeze(-1).flatten(1)
        mean = (returns * ended).sum(1) / ended.sum(1)
        self._last_return = torch.where(
            ended.any(1), mean, self._last_return
        )  # no episode ended: the last known
        target, weight = rollout.get("value_target").flatten(1), rollout.get("advantage").flatten(1)
        return {
            "return": self._last_return,
            "sigma": self.policy.std.mean(-1),
            "basis_size": self.critic.gp.size.clone(),
            "explained_variance": 1 - weight.var(1) / target.var(1),
            "gradient_norm": gradient_norm,
        }

    def state_dict(self) -> dict[str, Any]:
        """What was learned and where the random streams stand: tensors and plain numbers."""
        assert self.policy.noise is not None
        return {
            "updates": self.updates,
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "adam": self.adam.state_dict(),
            "noise": self.policy.noise.state(),
            "last_return": self._last_return,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        assert self.policy.noise is not None
        self.updates = state["updates"]
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.adam.load_state_dict(state["adam"])
        self.policy.noise.restore(state["noise"])
        self._last_return = state["last_return"]


def _controller(kind: str, observation_dim: int, action_dim: int, learners: range, seed: int) -> Controller:
    """The controller of that form, for the learners of those indices."""
    if kind == "linear":
        return LinearController(observation_dim, action_dim, (len(learners),))
    form = RBFController if kind == "rbf" else MLPController
    return form(observation_dim, action_dim, (len(learners),), seed=seed, first_learner=learners.start)
