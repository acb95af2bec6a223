"""Dynamic programming on Gaussian-process models: the learner for the least experience.

One update: act for a rollout on the plan, hopefully about what is unknown unless told otherwise, add it to
the experience, and, when that has grown enough, learn the model and plan anew. All learners at once, each on
its own experience. Model-based: where the other learners estimate values from the rewards that followed,
this one learns what each step does and computes what follows (Deisenroth, Rasmussen and Peters, 2009).
"""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torch_gprl.critics.planned_value import IMAGINED_STEPS, PlannedValue
from torch_gprl.critics.transition_model import TransitionModel, Transitions
from torch_gprl.learners.collecting import Collection, batch_of, mean_return
from torch_gprl.learners.dynamic_programming_config import DynamicProgrammingConfig
from torch_gprl.learners.experience import Experience
from torch_gprl.learners.q_learning import action_box_of
from torch_gprl.policies import PlannedPolicy
from torch_gprl.policies.streams import learner_generators, stacked_normal

REFIT_GROWTH = 2  # hyper-parameters are fitted whenever the experience has doubled


class DynamicProgramming:
    """Learns models of the steps, one for each learner of `env`, and acts on plans made with them.

    Args:
        env: environment of batch [learners, environments] with a bounded action.
        config: numbers of the algorithm.
        seed: of the exploration and of imagined states, learner by learner.
        first_learner: index of the first learner in those streams.
    """

    def __init__(
        self, env: EnvBase, config: DynamicProgrammingConfig, seed: int = 0, first_learner: int = 0
    ) -> None:
        self.env, self.config = env, config
        self.learners, num_envs = batch_of(env)
        states = env.observation_spec["observation"].shape[-1]
        low, high = action_box_of(env)
        indices = range(first_learner, first_learner + self.learners)
        self.model = TransitionModel(self.learners, states, len(low), config.model_budget)
        self.critic = PlannedValue(self.model, low, high, config.planning, config.acting_actions)
        self.policy = PlannedPolicy(self.critic, low, high, config, seed, indices)
        self.collection = Collection(env, self.policy, config.rollout_steps)
        self.frames_per_update = num_envs * config.rollout_steps
        self.total_updates = -(-config.total_frames // self.frames_per_update)
        self.updates = 0
        self._centre, self._half = (low + high) / 2, (high - low) / 2
        self._imagination = learner_generators(seed, indices, "weights")
        self.experience = Experience(self.total_updates * self.frames_per_update)
        self._planned, self._fitted = 0, 0  # steps of experience at the last plan and the last fit
        self._last_return = torch.full((self.learners,), torch.nan, device=env.device)

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        return self.updates * self.frames_per_update

    def train(self) -> Iterator[dict[str, Tensor]]:
        """Run the remaining updates; yields figures of each, [learners] every one."""
        while self.updates < self.total_updates:
            self.policy.anneal(self.updates / self.total_updates)
            rollout = self.collection.rollout()
            new = self._transitions(rollout)
            error = self._surprise(new)
            self.experience.extend(TensorDict(new._asdict(), new.reward.shape))
            self._plan()
            self.updates += 1
            yield self._figures(rollout) | {"model_error": error}

    def _transitions(self, rollout: TensorDictBase) -> Transitions:
        """The rollout's steps, [L, envs · T], in time order."""
        observation = rollout.get("observation")

        def flat(value: Tensor) -> Tensor:
            return value.to(self._half.dtype).transpose(1, 2).flatten(1, 2)

        following = rollout.get("next")
        return Transitions(
            flat(observation),
            (flat(rollout.get("action")) - self._centre) / self._half,
            flat(following.get("reward")).squeeze(-1),
            flat(following.get("observation")),
            flat(following.get("terminated")).squeeze(-1),
        )

    def _remembered(self, steps: int) -> Transitions:
        """The first so many steps of the experience."""
        stored = self.experience.all()
        return Transitions(*(stored.get(name)[:, :steps].to(self._half) for name in Transitions._fields))

    def _plan(self) -> None:
        """Learn the model and plan, if the experience has grown enough."""
        steps, config = len(self.experience), self.config
        if steps < config.first_steps or steps < (1 + config.growth) * self._planned:
            return
        data, fit = self._remembered(steps), steps >= REFIT_GROWTH * self._fitted
        self.model.solve(data, fit)
        self._planned, self._fitted = steps, steps if fit else self._fitted
        columns = 1 + IMAGINED_STEPS * len(self._half)
        draws = stacked_normal(self._imagination, (config.imagined, columns)).to(data.reward)
        self.critic.plan(data, torch.special.ndtr(draws), fresh=fit)

    def _surprise(self, new: Transitions) -> Tensor:
        """Root mean square error of the predicted reward on steps that the model has not seen [L]."""
        if not self.critic.planned:
            return torch.full((self.learners,), torch.nan, device=new.reward.device)
        predicted = self.critic.reward(new.observation, new.action)
        return (predicted - new.reward).square().mean(1).sqrt()

    def _figures(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        self._last_return = mean_return(rollout, self._last_return)
        return {"return": self._last_return}

    def state_dict(self) -> dict[str, Any]:
        """What was experienced and planned, and where the random streams stand: tensors and numbers."""
        return {
            "updates": self.updates,
            "planned": self._planned,
            "fitted": self._fitted,
            "experience": self.experience.state_dict(),
            "model": self.model.state_dict(),
            "plan": self.critic.state_dict(),
            "imagination": torch.stack([generator.get_state() for generator in self._imagination]),
            "collection": self.collection.state_dict(),
            "policy": self.policy.state(),
            "last_return": self._last_return,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.updates, self._planned, self._fitted = state["updates"], state["planned"], state["fitted"]
        self.model.load_state_dict(state["model"])
        self.experience.load_state_dict(state["experience"])
        if self._planned:
            planned_on = self._remembered(self._planned)
            self.model.solve(planned_on, fit=False)
            self.critic.load_state_dict(state["plan"], planned_on)
        for generator, saved in zip(self._imagination, state["imagination"], strict=True):
            generator.set_state(saved.clone())
        self.collection.load_state_dict(state["collection"])
        self.policy.restore(state["policy"])
        self._last_return = state["last_return"]
