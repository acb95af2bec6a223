"""Policy gradients with a Gaussian-process critic: the thesis' Claims 1 and 2 as a loop.

The baselines of the field are options of the same loop: REINFORCE, a neural state value with generalised
advantages, and the episodic natural actor-critic.

One update: collect a rollout, weigh its actions with the critic as it stood before, step the policy, teach
the critic. All learners at once, each on its own experience.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import kl_divergence
from torchrl.envs import EnvBase

from torch_gprl.critics import USE_ALL_ACTIONS, Evaluation, GPActionValue, GPValueEstimator
from torch_gprl.learners.collecting import Collection, batch_of, mean_return
from torch_gprl.learners.config import GUIDED, PolicyGradientConfig
from torch_gprl.learners.experience import Experience
from torch_gprl.learners.neural_value import NeuralTeacher, NeuralValue
from torch_gprl.learners.teaching import Teacher, make_critic
from torch_gprl.objectives import (
    AllActionLoss,
    PolicyGradientLoss,
    compatible_weights,
    episode_scores,
    natural_step,
    split_episodes,
    step_along,
)
from torch_gprl.policies import (
    AveragedPolicy,
    ConfidenceNoise,
    ConfidenceScale,
    Controller,
    GaussianPolicy,
    GibbsConfig,
    GibbsPolicy,
    LinearController,
    MLPController,
    RBFController,
    ScaledController,
    gaussian_policy,
)

FISHER_EVERY = 4  # one step in four of a rollout enters the Fisher matrix


class PolicyGradient:
    """Trains stochastic policies, one for each learner of `env`, with a critic for each.

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
        self.env, self.config = env, config
        self.learners, num_envs = batch_of(env)
        indices = range(first_learner, first_learner + self.learners)
        dims = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
        controller = _controller(config.controller, *dims, indices, seed).to(
            env.observation_spec["observation"].dtype
        )
        self.controller = controller.to(env.device)
        gaussian = gaussian_policy(controller, env.action_spec, config.std, seed, learners=indices)
        if config.average_over > 1:
            gaussian = AveragedPolicy(gaussian.head, gaussian.noise, config.average_over)
        gaussian.to(env.device)
        gaussian.head.log_std.requires_grad_(config.exploration == "learned")
        self.teacher = self._teacher(gaussian, seed, first_learner)
        self.critic = self.teacher.critic
        self.policy = self._explorer(gaussian)
        self.value_estimator = GPValueEstimator(
            self.critic, self.policy, config.discount, config.estimator, config.horizon, config.trace
        )
        self.losses = self._losses()
        kind = torch.optim.Adam if config.optimiser == "adam" else torch.optim.SGD
        self.optimiser = kind(self._trained(), lr=config.learning_rate)
        self.collection = Collection(env, self.policy, config.rollout_steps)
        self.frames_per_update = num_envs * config.rollout_steps
        self.total_updates = -(-config.total_frames // self.frames_per_update)
        self.updates = 0
        self._last_return = torch.full((self.learners,), torch.nan, device=env.device)

    def _teacher(self, policy: GaussianPolicy, seed: int, first_learner: int) -> Teacher | NeuralTeacher:
        """An empty critic, with what teaches it."""
        if self.config.critic == "gp":
            critic = make_critic(policy, self.config, self.learners).to(self.env.device)
            return Teacher(critic, policy, self.config)
        dims = self.controller.observation_dim
        return NeuralTeacher(NeuralValue(dims, self.learners, seed, first_learner).to(self.env.device))

    def _explorer(self, gaussian: GaussianPolicy) -> GaussianPolicy | ConfidenceNoise | GibbsPolicy:
        """The Gaussian policy, or one round the same controller that the critic guides."""
        config, head = self.config, gaussian.head
        if config.exploration not in GUIDED or not isinstance(self.teacher, Teacher):
            return gaussian
        critic = self.teacher.critic
        low, high = head.centre - head.half_range, head.centre + head.half_range
        greedy = ScaledController(head.controller, low, high)
        if config.exploration == "confidence":
            scale = ConfidenceScale(config.std**2, config.final_std, max(1.0, config.final_std))
            policy = ConfidenceNoise(greedy, critic, scale, gaussian.noise)
        else:
            first, last = config.inverse_temperature, config.final_inverse_temperature
            numbers = GibbsConfig(config.gibbs_form, first, last, config.std)
            policy = GibbsPolicy(greedy, critic, numbers, gaussian.noise)
        self.teacher.policy = policy.to(self.env.device)
        return policy

    def _losses(self) -> list[PolicyGradientLoss | AllActionLoss]:
        """The terms of the objective: sampled scores, all actions in closed form, or both."""
        losses: list[PolicyGradientLoss | AllActionLoss] = []
        if self.config.estimator != "all-action":
            losses.append(PolicyGradientLoss(self.policy))
        if self.config.estimator in USE_ALL_ACTIONS and isinstance(self.critic, GPActionValue):
            losses.append(AllActionLoss(self.policy, self.critic))
        return losses

    def _trained(self) -> list[torch.nn.Parameter]:
        return [parameter for parameter in self.policy.parameters() if parameter.requires_grad]

    @property
    def experience(self) -> Experience | None:
        """What the critic is taught anew from, if it is."""
        return self.teacher.experience

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        return self.updates * self.frames_per_update

    def train(self) -> Iterator[dict[str, Tensor]]:
        """Run the remaining updates; yields figures of each, [learners] every one."""
        while self.updates < self.total_updates:
            rollout = self.collection.rollout()
            if self.updates == 0:
                self._standardise(rollout)
            seen = self._weigh(rollout)
            # an empty critic is no baseline: the first rollout serves as its own
            taught = self.config.in_sample or self.updates == 0
            if taught:
                self.teacher.teach(rollout, self.updates)
                self._weigh(rollout)
            step = self._step_policy(rollout)
            if not taught:
                self.teacher.teach(rollout, self.updates)
            self._improve()
            self.updates += 1
            yield self._figures(rollout, seen) | step

    @torch.no_grad()
    def _standardise(self, rollout: TensorDictBase) -> None:
        """Scale the controller's inputs by the first rollout; until then it acts zero everywhere."""
        observation = rollout.get("observation").flatten(1, 2)
        std = observation.std(1)
        self.controller.standardise(observation.mean(1), torch.where(std > 1e-6, std, 1.0))

    @torch.no_grad()
    def _weigh(self, rollout: TensorDictBase) -> Evaluation:
        """Write `value_target` and `advantage`, the weights w_t of the scores; returns what was seen."""
        seen = self.value_estimator.evaluate(rollout)
        self.value_estimator.write(rollout, seen)
        if self.config.discount_states:
            weight = self.config.discount ** rollout.get("step_count").to(seen.value.dtype)  # γ^t
            rollout.set("state_weight", weight)
            rollout.set("advantage", weight * rollout.get("advantage"))
        return seen

    def _step_policy(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """One step along the gradient of all learners; figures of each one's gradient."""
        parameters = self._trained()
        figures = self._differentiate(rollout, parameters)
        self._move(rollout, parameters)
        self._anneal((self.updates + 1) / self.total_updates)
        return figures

    def _improve(self) -> None:
        """More steps without new experience: the critic solved anew each time, all actions at landmarks."""
        if not self.config.improvements:
            return
        assert isinstance(self.teacher, Teacher)
        landmarks, parameters = self.teacher.landmarks(), self._trained()
        for _ in range(self.config.improvements):
            self.teacher.solve_anew()
            self.optimiser.zero_grad()
            self.losses[-1](landmarks)["loss_all_action"].backward()
            self._move(landmarks, parameters)

    def _move(self, rollout: TensorDictBase, parameters: list[torch.nn.Parameter]) -> None:
        """Step along the gradient that is set, at states of the rollout."""
        left = 1 - self.updates / self.total_updates
        if self.config.optimiser == "natural":
            region, damping = self.config.trust_region * left, self.config.damping
            natural_step(parameters, self._divergence(rollout), region, damping=damping)
        elif self.config.optimiser == "episodic-natural":
            direction = self._regress_on_episodes(rollout, parameters)
            step_along(direction, parameters, self._divergence(rollout), self.config.trust_region * left)
        else:
            self.optimiser.param_groups[0]["lr"] = self.config.learning_rate * left
            self.optimiser.step()
        if isinstance(self.policy, AveragedPolicy):
            self.policy.follow()

    def _anneal(self, done: float) -> None:
        """Set what changes in the exploration by a schedule, for a share of the training that is over."""
        if isinstance(self.policy, GibbsPolicy):
            self.policy.anneal(done)
        elif isinstance(self.policy, GaussianPolicy) and self.config.exploration == "scheduled":
            std = self.config.std + done * (self.config.final_std - self.config.std)
            self.policy.head.log_std.data.fill_(math.log(std))

    def _differentiate(
        self, rollout: TensorDictBase, parameters: list[torch.nn.Parameter]
    ) -> dict[str, Tensor]:
        """Set the gradient, half of the environments at a time; its norm and the cosine between the halves.

        The cosine says what is signal and what is noise; it is NaN with one environment.
        """
        total, gradients = rollout.shape[1], []
        self.optimiser.zero_grad()
        for half in rollout.chunk(2, dim=1):
            before = _gradient(parameters)
            loss = sum(next(iter(term(half).values())) for term in self.losses)
            (loss * (half.shape[1] / total)).backward()
            gradients.append(_gradient(parameters) - before)
        one, other = gradients[0], gradients[-1]
        cosine = torch.cosine_similarity(one, other, dim=1) if len(gradients) == 2 else one[:, 0] * torch.nan
        return {"gradient_norm": _gradient(parameters).norm(dim=1), "gradient_cosine": cosine}

    def _regress_on_episodes(
        self, rollout: TensorDictBase, parameters: list[torch.nn.Parameter]
    ) -> Float[Tensor, "learners P"]:
        """The natural gradient as the episodic natural actor-critic finds it."""
        discount = self.config.discount if self.config.discount_states else 1.0
        episodes = split_episodes(rollout.get(("next", "done")).squeeze(-1), discount)
        distribution = self.policy.get_dist(rollout)
        scores = episode_scores(distribution.log_prob(rollout.get("action")), parameters, episodes)
        returns = episodes.sums(rollout.get(("next", "reward")).squeeze(-1))
        return compatible_weights(scores, returns, episodes.used).to(parameters[0].dtype)

    def _divergence(self, rollout: TensorDictBase) -> Callable[[], Tensor]:
        """Mean KL(π_now ‖ π_θ) over states of the rollout [learners], a function of the parameters θ."""
        some, policy = rollout[:, :, ::FISHER_EVERY], self.policy
        if not isinstance(policy, GaussianPolicy):
            with torch.no_grad():
                now = policy.get_dist(some)
            return lambda: kl_divergence(now, policy.get_dist(some)).flatten(1).mean(1)
        observation, head = rollout.get("observation")[:, :, ::FISHER_EVERY], policy.head
        with torch.no_grad():
            loc, scale = head.parameters_at(observation)

        def divergence() -> Tensor:
            new_loc, new_scale = head.parameters_at(observation)
            ratio = (scale.square() + (loc - new_loc).square()) / (2 * new_scale.square())
            return (new_scale.log() - scale.log() + ratio - 0.5).sum(-1).flatten(1).mean(1)

        return divergence

    @torch.no_grad()
    def _figures(self, rollout: TensorDictBase, seen: Evaluation) -> dict[str, Tensor]:
        """Figures of the rollout, and of the critic as it stood before it, [learners] each."""
        self._last_return = mean_return(rollout, self._last_return)
        error = (seen.to_go - seen.taken).flatten(1)
        surprise = (seen.to_go - seen.value).flatten(1)
        return self.teacher.figures() | {
            "return": self._last_return,
            "sigma": rollout.get("scale").flatten(1).mean(1),
            "value_error": error.square().mean(1).sqrt(),
            "explained_variance": 1 - surprise.var(1) / seen.to_go.flatten(1).var(1),
        }

    def state_dict(self) -> dict[str, Any]:
        """What was learned, and where environment and random streams stand: tensors and plain numbers."""
        assert self.policy.noise is not None
        return {
            "updates": self.updates,
            "policy": self.policy.state_dict(),
            "teacher": self.teacher.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "noise": self.policy.noise.state(),
            "last_return": self._last_return,
            "collection": self.collection.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        assert self.policy.noise is not None
        self.updates = state["updates"]
        self.policy.load_state_dict(state["policy"])
        self.teacher.load_state_dict(state["teacher"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.collection.load_state_dict(state["collection"])
        self.policy.noise.restore(state["noise"])
        self._last_return = state["last_return"]


def _gradient(parameters: list[torch.nn.Parameter]) -> Tensor:
    """The gradients as one vector for each learner [learners, P]; 0 where there is none yet."""
    parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    return torch.cat([part.flatten(1) for part in parts], 1).clone()


def _controller(kind: str, observation_dim: int, action_dim: int, learners: range, seed: int) -> Controller:
    """The controller of that form, for the learners of those indices."""
    if kind == "linear":
        return LinearController(observation_dim, action_dim, (len(learners),))
    form = RBFController if kind == "rbf" else MLPController
    return form(observation_dim, action_dim, (len(learners),), seed=seed, first_learner=learners.start)
