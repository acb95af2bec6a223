"""Flat runners and swimmers of Gymnasium: HalfCheetah, Hopper, Walker2d and Swimmer.

Each is paid for its speed along x and charged for its control; the two that can fall are paid for each
healthy step.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from envs.gym.base import GymnasiumTask, asset, squares
from envs.physics import State
from envs.task import Reward

VELOCITY_CLIP = 10.0  # in what Hopper and Walker2d observe


@dataclass(frozen=True, kw_only=True)
class Runner(GymnasiumTask):
    """Run along x: reward speed, charge control."""

    control_weight: float  # reward per squared action
    hidden: int = 1  # leading positions that the agent does not see

    def observation(self, state: State) -> Float[np.ndarray, "B do"]:
        """Positions without the first `hidden`, and velocities."""
        return np.concatenate([state.qpos[:, self.hidden :], state.qvel], axis=-1)

    def costs(
        self, before: State, action: Float[np.ndarray, "B da"], after: State
    ) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"]]:
        """Speed along x in m/s and the cost of control."""
        speed = (after.qpos[:, 0] - before.qpos[:, 0]) / self.control_step
        return speed, squares(action) * self.control_weight

    def reward(self, before: State, action: Float[np.ndarray, "B da"], after: State) -> Reward:
        """`forward` speed less `ctrl`."""
        forward, control = self.costs(before, action, after)
        return Reward(forward - control, {"forward": forward, "ctrl": -control})


@dataclass(frozen=True, kw_only=True)
class Walker(Runner):
    """A runner that can fall: one point of reward for each healthy step, the end when it is not."""

    heights: tuple[float, float]  # m, of the torso, when healthy
    angles: tuple[float, float]  # rad, of the torso, when healthy
    largest: float = float("inf")  # of all other entries of the state, when healthy

    def observation(self, state: State) -> Float[np.ndarray, "B do"]:
        """Positions without x, and velocities clipped to ±10."""
        clipped = state.qvel.clip(-VELOCITY_CLIP, VELOCITY_CLIP)
        return np.concatenate([state.qpos[:, self.hidden :], clipped], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B da"], after: State) -> Reward:
        """`forward` speed and `survive`, less `ctrl`."""
        forward, control = self.costs(before, action, after)
        survive = (~self.terminated(after)).astype(np.float64)
        return Reward(forward + survive - control, {"forward": forward, "survive": survive, "ctrl": -control})

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """Torso too low, too high or too far tilted, or the state out of bounds."""
        height, angle = state.qpos[:, 1], state.qpos[:, 2]
        healthy = (self.heights[0] < height) & (height < self.heights[1])
        healthy &= (self.angles[0] < angle) & (angle < self.angles[1])
        if self.largest < float("inf"):
            rest = np.concatenate([state.qpos[:, 2:], state.qvel], axis=-1)
            healthy &= (np.abs(rest) < self.largest).all(axis=-1)
        return ~healthy


TASKS = (
    Runner(
        id="HalfCheetah-v5",
        scene=asset("half_cheetah.xml"),
        horizon=1000,
        control_step=0.01 * 5,
        frame_skip=5,
        action_low=(-1.0,) * 6,
        action_high=(1.0,) * 6,
        start_noise=0.1,
        normal_velocities=True,
        control_weight=0.1,
    ),
    Walker(
        id="Hopper-v5",
        scene=asset("hopper.xml"),
        horizon=1000,
        control_step=0.002 * 4,
        frame_skip=4,
        action_low=(-1.0,) * 3,
        action_high=(1.0,) * 3,
        start_noise=5e-3,
        control_weight=1e-3,
        heights=(0.7, float("inf")),
        angles=(-0.2, 0.2),
        largest=100.0,
    ),
    Walker(
        id="Walker2d-v5",
        scene=asset("walker2d_v5.xml"),
        horizon=1000,
        control_step=0.002 * 4,
        frame_skip=4,
        action_low=(-1.0,) * 6,
        action_high=(1.0,) * 6,
        start_noise=5e-3,
        control_weight=1e-3,
        heights=(0.8, 2.0),
        angles=(-1.0, 1.0),
    ),
    Runner(
        id="Swimmer-v5",
        scene=asset("swimmer.xml"),
        horizon=1000,
        control_step=0.01 * 4,
        frame_skip=4,
        action_low=(-1.0,) * 2,
        action_high=(1.0,) * 2,
        start_noise=0.1,
        control_weight=1e-4,
        hidden=2,
    ),
)
