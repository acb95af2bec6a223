"""A Gymnasium environment of one's own, and the ten lines that train it: a puck that glides to the origin.

Run it: `python examples/own_environment.py`
"""

from typing import Any

import gymnasium
import numpy as np
from torchrl.envs import GymWrapper, SerialEnv

from torch_gprl.learners import PolicyGradient, PolicyGradientConfig


class Puck(gymnasium.Env):
    """A mass on ice, pushed by a force: position and velocity are seen, both should become zero."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)  # force, N

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple:
        """Start at rest, up to 1 m away."""
        super().reset(seed=seed)
        self._state, self._steps = np.array([self.np_random.uniform(-1, 1), 0.0]), 0
        return self._state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple:
        """Push for 0.1 s; after 5 s the time is up, which is not an end of the game."""
        position, velocity = self._state
        velocity = velocity + 0.1 * float(np.clip(action[0], -1, 1))
        self._state = np.array([position + 0.1 * velocity, velocity])
        self._steps += 1
        reward = float(np.exp(-4 * np.square(self._state).sum()))
        return self._state.astype(np.float32), reward, False, self._steps == 50, {}


def train(learners: int = 3, copies: int = 5, total_frames: int = 30_000) -> PolicyGradient:
    """Train independent learners side by side, each on its own copies of the environment."""
    env = SerialEnv(learners, lambda: SerialEnv(copies, lambda: GymWrapper(Puck())))
    env.set_seed(0)
    config = PolicyGradientConfig(total_frames=total_frames, rollout_steps=100, discount=0.95)
    learner = PolicyGradient(env, config, seed=0)
    for figures in learner.train():
        print(learner.frames, "steps, returns", " ".join(f"{value:5.1f}" for value in figures["return"]))
    env.close()
    return learner


if __name__ == "__main__":
    train()
