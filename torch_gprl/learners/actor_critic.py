"""Actor-critic with a Gaussian process that solves all experience anew: control from hundreds of steps.

One update: act for a few steps; then, a few times in turn, solve the temporal differences of everything that
was seen under today's policy (`DifferenceEquations`), and move the policy's actions in all states seen along
the slopes of the value, by a damped Newton step,

    a ← clip(a + ∇_a Q / (|∂²Q/∂a²|₋ + damping)),     damping = rms(∇_a Q)/trust region

which the controller then follows by weighted least squares. The damping bounds the step where the value bends
up or hardly at all, and lets it shrink as the slopes do. All learners at once, each on its own experience.
"""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torch_gprl.critics import GPActionValue
from torch_gprl.critics.difference_equations import DifferenceEquations, Slopes, Transitions
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.gp.prescribed import adopt_basis
from torch_gprl.kernels import Matern
from torch_gprl.learners.actor_critic_config import ActorCriticConfig
from torch_gprl.learners.collecting import Collection, batch_of, mean_return
from torch_gprl.learners.experience import Experience
from torch_gprl.policies import ConfidenceNoise, MLPController, NoiseStream, ScaledController
from torch_gprl.policies.gaussian import action_bounds

REMEMBERED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
)
RENEWAL = 1.2  # growth of experience between renewals of scaling and basis


class ActorCritic:
    """Trains a deterministic controller, one for each learner of `env`, on the slopes of its action value.

    Args:
        env: environment of batch [learners, environments] with a bounded action.
        config: numbers of the algorithm.
        seed: of initial weights and of exploration, learner by learner: learner i of many learns what
            learner i alone would, if the environment's random numbers keep learners apart too.
        first_learner: index of the first learner in those streams.
    """

    def __init__(
        self, env: EnvBase, config: ActorCriticConfig, seed: int = 0, first_learner: int = 0
    ) -> None:
        self.env, self.config = env, config
        self.learners, num_envs = batch_of(env)
        indices = range(first_learner, first_learner + self.learners)
        spec = env.observation_spec["observation"]
        states, actions = spec.shape[-1], env.action_spec.shape[-1]
        low, high = action_bounds(env.action_spec, actions)
        controller = MLPController(
            states, actions, (self.learners,), (config.hidden,) * 2, seed, first_learner
        )
        self.actor = ScaledController(controller, low, high).to(env.device, spec.dtype)
        self.critic = self._make_critic(states, low, high).to(env.device)
        noise = NoiseStream(seed, indices)
        self.policy = ConfidenceNoise(self.actor, self.critic, config.confidence, noise)
        self.optimiser = torch.optim.Adam(controller.parameters(), config.learning_rate, betas=(0.9, 0.99))
        self.collection = Collection(env, self.policy, config.rollout_steps)
        self.experience = Experience(config.total_frames)
        self.frames_per_update = num_envs * config.rollout_steps
        self.total_updates = -(-config.total_frames // self.frames_per_update)
        self.updates = self.solved = self.renewed = 0
        self._last_return = torch.full((self.learners,), torch.nan, device=env.device)

    def _make_critic(self, states: int, low: Tensor, high: Tensor) -> GPActionValue:
        """An empty critic, one Gaussian process for each learner."""
        actions = len(low)
        lengthscale = torch.full((states + actions,), self.config.action_lengthscale, dtype=torch.float64)
        lengthscale[:states] = self.config.lengthscale * states**0.5
        kernel = Matern(states + actions, lengthscale, batch_shape=(self.learners,), smoothness=2.5)
        # in prior variances of the value, which `_scale_values` ties to those of the reward
        noise = self.config.noise * ((1 - self.config.discount) / self.config.amplitude) ** 2
        gp = SparseOnlineGP(kernel.requires_grad_(False), self.config.budget, noise, overshoot=1)
        return GPActionValue(gp, action_low=low.double(), action_high=high.double())

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        return self.updates * self.frames_per_update

    def train(self) -> Iterator[dict[str, Tensor]]:
        """Run the remaining updates; yields figures of each, [learners] every one."""
        while self.updates < self.total_updates:
            rollout = self.collection.rollout()
            self.experience.extend(rollout.select(*REMEMBERED).reshape(self.learners, -1))
            self.updates += 1
            seen, error = len(self.experience), self._surprise(rollout)
            if seen >= self.config.first_frames and seen >= self.solved * (1 + self.config.growth):
                self.learn()
            yield self._figures(rollout) | {"td_error": error}

    def learn(self) -> None:
        """Evaluate and improve the policy on everything that was seen."""
        data = Transitions.of(self.experience.all(), self.critic.input_loc)
        if len(self.experience) >= self.renewed * RENEWAL:
            self._renew(data)
        self._scale_values(data)
        equations = DifferenceEquations(self.critic, data, self.config.discount)
        actor = self.actor
        observation = data.next_observation.to(actor.centre.dtype)
        for sweep in range(self.config.sweeps):
            with torch.no_grad():
                action = actor.controller(observation).to(data.reward.dtype).clamp(-1, 1)
            slopes = equations.solve(actor.centre + actor.half_range * action)
            target, weight = self._step(action, slopes)
            alive = ~data.terminated.unsqueeze(-1)  # no action is taken in terminal states
            self._follow(observation, target, weight * alive, offset=sweep)
        self.solved = len(self.experience)

    def _renew(self, data: Transitions) -> None:
        """Scale inputs by all that was seen, actions by their range, and choose the basis among all."""
        critic, actor = self.critic, self.actor
        loc, std = data.observation.mean(1), data.observation.std(1)
        std = torch.where(std > 1e-6, std, 1.0)
        critic.input_loc.copy_(torch.cat([loc, actor.centre.expand(len(loc), -1)], -1))
        critic.input_scale.copy_(torch.cat([std, actor.half_range.expand(len(loc), -1)], -1))
        actor.controller.standardise(loc, std)
        adopt_basis(critic.gp, critic.inputs(data.observation, data.action))
        self.renewed = len(self.experience)

    @torch.no_grad()
    def _scale_values(self, data: Transitions) -> None:
        """The prior of values by the moments of the reward: where nothing is known it stays at its mean."""
        critic, config = self.critic, self.config
        mean, variance = data.reward_moments()
        std = torch.where(variance > 0, variance.sqrt(), 1.0)
        critic.target_loc.copy_(mean / (1 - config.discount))
        critic.target_scale.copy_(config.amplitude * std / (1 - config.discount))

    def _step(self, action: Tensor, slopes: Slopes) -> tuple[Tensor, Tensor]:
        """Actions that the controller should take instead, and how much each matters, [learners, N, A]."""
        gradient = slopes.gradient
        outward = (action.abs() >= 1) & (action * gradient > 0)
        rms = gradient.masked_fill(outward, 0).square().mean((1, 2), keepdim=True).sqrt()
        damping = (rms / self.config.trust_region).clamp_min(torch.finfo(rms.dtype).tiny)
        weight = damping - slopes.curvature.clamp_max(0)
        return (action + gradient / weight).clamp(-1, 1), weight / weight.mean((1, 2), keepdim=True)

    def _follow(self, observation: Tensor, target: Tensor, weight: Tensor, offset: int) -> None:
        """Fit the controller to the targets, on another subset of the states at each step."""
        steps, controller = self.config.fit_steps, self.actor.controller
        target, weight = target.to(observation.dtype), weight.to(observation.dtype)
        stride = max(1, observation.shape[1] // self.config.batch)
        for step in range(steps):
            some = slice((offset * steps + step) % stride, None, stride)
            error = controller(observation[:, some]) - target[:, some]
            loss = (weight[:, some] * error.square()).mean((1, 2)).sum()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()

    @torch.no_grad()
    def _surprise(self, rollout: TensorDictBase) -> Tensor:
        """Root mean square of r + γ Q(s', f(s')) − Q(s, a) on experience that the critic has not seen."""
        following = rollout.get("next")
        observation = following.get("observation")
        value = self.critic.mean_value(observation, self.actor(observation))
        beyond = torch.where(following.get("terminated").squeeze(-1), 0.0, value)
        target = following.get("reward").squeeze(-1) + self.config.discount * beyond
        expected = self.critic.mean_value(rollout.get("observation"), rollout.get("action"))
        return (target - expected).flatten(1).square().mean(1).sqrt()

    @torch.no_grad()
    def _figures(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Figures of a rollout and of the critic, [learners] each."""
        self._last_return = mean_return(rollout, self._last_return)
        value = self.critic.mean_value(rollout.get("observation"), rollout.get("action"))
        return {
            "return": self._last_return,
            "sigma": rollout.get("action_std").flatten(1).mean(1),
            "basis_size": self.critic.gp.size.clone(),
            "value": value.flatten(1).mean(1),
        }

    def state_dict(self) -> dict[str, Any]:
        """What was learned and where the random streams stand: tensors and plain numbers."""
        assert self.policy.noise is not None
        return {
            "updates": self.updates,
            "solved": self.solved,
            "renewed": self.renewed,
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "experience": self.experience.state_dict(),
            "collection": self.collection.state_dict(),
            "noise": self.policy.noise.state(),
            "last_return": self._last_return,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        assert self.policy.noise is not None
        self.updates, self.solved, self.renewed = (state[name] for name in ("updates", "solved", "renewed"))
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.experience.load_state_dict(state["experience"])
        self.collection.load_state_dict(state["collection"])
        self.policy.noise.restore(state["noise"])  # last: loading a collection tries the policy
        self._last_return = state["last_return"]
