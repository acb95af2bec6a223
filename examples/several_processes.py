"""Workers that collect while the learner learns, and a learner that survives the loss of one.

Run it: `python examples/several_processes.py`
"""

import contextlib
import functools
from pathlib import Path

import gymnasium
import torch
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from torch_gprl.learners import PolicyGradient, PolicyGradientConfig, WorkerCollection

LEARNERS = 2


def make_env(copies: int, seed: int) -> EnvBase:
    """Copies of Gymnasium's pendulum for each learner."""
    env = SerialEnv(LEARNERS, lambda: SerialEnv(copies, lambda: GymWrapper(gymnasium.make("Pendulum-v1"))))
    env.set_seed(seed)
    return env


def train(saved: Path, updates: int = 20, workers: int = 2, copies: int = 2) -> PolicyGradient:
    """Train with several processes, and keep what was learned whatever happens to them."""
    config = PolicyGradientConfig(total_frames=updates * workers * copies * 200, rollout_steps=200)
    learner = PolicyGradient(make_env(workers * copies, seed=0), config)
    factories = [functools.partial(make_env, copies, seed) for seed in range(1, workers + 1)]
    collection = WorkerCollection(factories, learner.policy, config.rollout_steps)
    learner.collection = collection
    with contextlib.closing(collection):
        try:
            for figures in learner.train():
                print(learner.frames, "steps, returns", figures["return"].tolist())
        finally:
            torch.save(learner.state_dict(), saved)
    return learner


if __name__ == "__main__":
    train(Path("learner.pt"))
