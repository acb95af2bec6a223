"""What `sample_efficiency` compares: tasks with their thresholds, our learners, and Stable-Baselines3's.

An arm is a generator: it trains some seeds side by side and stops every so many environment steps to show its
policy. What it does between two stops is what it costs.

The peers' settings are those of rl-baselines3-zoo (hyperparams/ppo.yml and sac.yml), for the nearest version
of each task; where the zoo has none, the library's defaults. `SAC small` is SAC as one would tune it for few
samples: two layers of 64, four updates a step.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

import envs
from benchmarks.env_steps import gymnasium_id
from torch_gprl import learners
from torch_gprl.policies import ConfidenceScale


@dataclass(frozen=True)
class Goal:
    """When a task counts as learned, and how long to try.

    Args:
        thresholds: mean returns over the evaluation's episodes.
        frames: environment steps of our learners.
        every: environment steps between evaluations of our learners.
        peer_frames: environment steps of PPO and of SAC.
    """

    thresholds: tuple[float, ...]
    frames: int
    every: int
    peer_frames: dict[str, int]


GOALS = {
    "Pendulum-v1": Goal((-200.0, -160.0), 1_500, 100, {"PPO": 60_000, "SAC": 6_000}),
    "InvertedPendulum-v5": Goal((950.0,), 6_000, 150, {"PPO": 50_000, "SAC": 5_000}),
    "pendulum-explore": Goal((50.0,), 1_500, 100, {"PPO": 100_000, "SAC": 5_000}),
    # its optimum is near 200; above 120 the pole is up for more than half of the episode
    "cartpole-swingup": Goal((120.0,), 1_500, 150, {"PPO": 200_000, "SAC": 20_000}),
    "MountainCarContinuous-v0": Goal((90.0,), 2_500, 500, {"PPO": 50_000, "SAC": 50_000}),
    "Reacher-v5": Goal((-5.0,), 4_000, 500, {"PPO": 200_000, "SAC": 30_000}),
}
PEER_STOPS = 40  # evaluations of a peer

Shown = tuple[int, TensorDictModuleBase]
"""Environment steps so far, and the policy that they made."""


@dataclass(frozen=True)
class Arm:
    """A way to learn.

    Args:
        train: (task, seeds, environment steps, steps between stops) to what it shows at each stop.
        family: PPO or SAC for the peers, whose budgets are their own; None for ours.
        side_by_side: seeds trained in one program.
    """

    train: Callable[[str, range, int, int], Iterator[Shown]]
    family: str | None = None
    side_by_side: int = 1

    def budget(self, goal: Goal) -> tuple[int, int]:
        """Environment steps in all, and between stops."""
        if self.family is None:
            return goal.frames, goal.every
        frames = goal.peer_frames[self.family]
        return frames, frames // PEER_STOPS


def ours(name: str, **numbers: object) -> Arm:
    """One of our learners, by the name of its class; `numbers` replace defaults of its config."""

    def train(task: str, seeds: range, frames: int, every: int) -> Iterator[Shown]:
        env = envs.make(task, learners=len(seeds), num_envs=1, seed=0, first_learner=seeds.start, threads=1)
        config = getattr(learners, f"{name}Config")(total_frames=frames, **numbers)
        learner = getattr(learners, name)(env, config, seed=0, first_learner=seeds.start)
        stop = every
        for _ in learner.train():
            if learner.frames >= stop:
                yield learner.frames, learner.policy
                stop = learner.frames + every

    return Arm(train, side_by_side=10)


# ---------------------------------------------------------------- Stable-Baselines3


@dataclass(frozen=True)
class Setting:
    """Arguments of a peer's constructor, and how it sees its environment."""

    numbers: dict[str, Any] = field(default_factory=dict)
    num_envs: int = 1
    normalise: bool = False  # running statistics of observations and rewards


PPO_SETTINGS = {
    "Pendulum-v1": Setting(
        {"n_steps": 1024, "gae_lambda": 0.95, "gamma": 0.9, "n_epochs": 10, "ent_coef": 0.0}
        | {"learning_rate": 1e-3, "clip_range": 0.2, "use_sde": True, "sde_sample_freq": 4},
        num_envs=4,
    ),
    "MountainCarContinuous-v0": Setting(
        {"batch_size": 256, "n_steps": 8, "gamma": 0.9999, "learning_rate": 7.77e-5, "ent_coef": 0.00429}
        | {"clip_range": 0.1, "n_epochs": 10, "gae_lambda": 0.9, "max_grad_norm": 5, "vf_coef": 0.19}
        | {"use_sde": True, "policy_kwargs": {"log_std_init": -3.29, "ortho_init": False}},
        normalise=True,
    ),
    "InvertedPendulum-v5": Setting(
        {"batch_size": 64, "n_steps": 32, "gamma": 0.999, "learning_rate": 0.000222425, "n_epochs": 5}
        | {"ent_coef": 1.37976e-07, "clip_range": 0.4, "gae_lambda": 0.9, "max_grad_norm": 0.3}
        | {"vf_coef": 0.19816},
        normalise=True,
    ),
    "Reacher-v5": Setting(
        {"batch_size": 32, "n_steps": 512, "gamma": 0.9, "learning_rate": 0.000104019, "n_epochs": 5}
        | {"ent_coef": 7.52585e-08, "clip_range": 0.3, "gae_lambda": 1.0, "max_grad_norm": 0.9}
        | {"vf_coef": 0.950368},
        normalise=True,
    ),
}
SAC_SETTINGS = {
    "Pendulum-v1": Setting({"learning_rate": 1e-3}),
    "MountainCarContinuous-v0": Setting(
        {"learning_rate": 3e-4, "buffer_size": 50_000, "batch_size": 512, "ent_coef": 0.1, "train_freq": 32}
        | {"gradient_steps": 32, "gamma": 0.9999, "tau": 0.01, "learning_starts": 0, "use_sde": True}
        | {"policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64]}},
    ),
}
SMALL_SAC = {"policy_kwargs": {"net_arch": [64, 64]}, "gradient_steps": 4, "learning_rate": 1e-3}


def peer(family: str, settings: dict[str, Setting], changes: dict[str, Any] | None = None) -> Arm:
    """PPO or SAC of Stable-Baselines3."""

    def train(task: str, seeds: range, frames: int, every: int) -> Iterator[Shown]:
        import stable_baselines3
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.vec_env import VecNormalize

        setting = settings.get(task, Setting())
        env = make_vec_env(gymnasium_id(envs.ALL[task]), setting.num_envs, seed=seeds.start)
        if setting.normalise:
            env = VecNormalize(env, gamma=setting.numbers.get("gamma", 0.99))
        numbers = setting.numbers | (changes or {})
        model = getattr(stable_baselines3, family)(
            "MlpPolicy", env, seed=seeds.start, device="cpu", **numbers
        )
        while model.num_timesteps < frames:
            model.learn(every, reset_num_timesteps=False)
            yield model.num_timesteps, PeerPolicy(model, envs.ALL[task])
        env.close()

    return Arm(train, family)


class PeerPolicy(TensorDictModuleBase):
    """A model of Stable-Baselines3 as a tensordict module, deterministic, for our environments.

    Args:
        model: a trained algorithm.
        task: whose action it chooses: in shares of the actuators' bounds unless the task is Gymnasium's own.
    """

    def __init__(self, model: Any, task: envs.Task) -> None:  # noqa: ANN401  (an optional library's class)
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action"]
        self.model = model
        own = task.id not in gymnasium.registry
        low, high = np.array(task.action_low), np.array(task.action_high)
        self.centre, self.reach = ((high + low) / 2, (high - low) / 2) if own else (0.0, 1.0)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        observation = tensordict.get("observation")
        flat = observation.flatten(0, -2).numpy()
        normaliser = self.model.get_vec_normalize_env()
        if normaliser is not None:
            flat = normaliser.normalize_obs(flat)
        action, _ = self.model.predict(flat, deterministic=True)
        shape = (*observation.shape[:-1], -1)
        return tensordict.set(
            "action", torch.as_tensor(self.centre + self.reach * action).to(observation).view(shape)
        )


ARMS = {
    "q-learning": ours("QLearning"),
    "actor-critic": ours("ActorCritic"),
    "dynamic programming": ours("DynamicProgramming"),
    "PPO": peer("PPO", PPO_SETTINGS),
    "SAC": peer("SAC", SAC_SETTINGS),
    "SAC small": peer("SAC", {}, SMALL_SAC),
}
MAIN = tuple(ARMS)
# what each part brings: run by name
BY_CONFIDENCE = ConfidenceScale(noise_scale=100.0, floor=0.1, ceiling=0.6)
ARMS |= {
    "q-learning, online": ours("QLearning", targets="online"),
    "q-learning, squared exponential": ours("QLearning", kernel="squared-exponential"),
    "q-learning, half the noise": ours("QLearning", std=0.3),
    "q-learning, optimistic": ours("QLearning", optimism=1.0),
    "q-learning, pessimistic": ours("QLearning", optimism=-1.0),
    "actor-critic, noise by confidence": ours("ActorCritic", confidence=BY_CONFIDENCE),
    "actor-critic, one sweep": ours("ActorCritic", sweeps=1),
    "actor-critic, steps of any length": ours("ActorCritic", trust_region=10.0),
    "actor-critic, short steps": ours("ActorCritic", trust_region=0.1),
    "actor-critic, solved at every look": ours("ActorCritic", growth=0.0),
    "actor-critic, less noise of rewards": ours("ActorCritic", noise=1e-5),
}
