"""Gymnasium's pendulums on carts: InvertedPendulum and InvertedDoublePendulum."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from envs.gym.base import GymnasiumTask, asset
from envs.physics import State
from envs.task import Reward


@dataclass(frozen=True, kw_only=True)
class InvertedPendulum(GymnasiumTask):
    """Balance a pole."""

    LARGEST_ANGLE = 0.2  # rad

    def observation(self, state: State) -> Float[np.ndarray, "B 4"]:
        """Positions and velocities of cart and pole."""
        return np.concatenate([state.qpos, state.qvel], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`survive`: one for each step that does not end the episode."""
        return Reward.of(survive=(~self.terminated(after)).astype(np.float64))

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """The pole beyond 0.2 rad."""
        return np.abs(state.qpos[:, 1]) > self.LARGEST_ANGLE


@dataclass(frozen=True, kw_only=True)
class InvertedDoublePendulum(GymnasiumTask):
    """Balance two poles, one on the other."""

    SURVIVE = 10.0
    LEAST_HEIGHT = 1.0  # m, of the upper tip
    CLIP = 10.0  # of velocities and of the force that holds the cart on its rail, as observed

    def observation(self, state: State) -> Float[np.ndarray, "B 9"]:
        """Cart position, sines and cosines of the joints, velocities, and the rail's force."""
        angles, rail = state.qpos[:, 1:], state.derived["qfrc_constraint"][:, :1]
        clipped = np.concatenate([state.qvel, rail], axis=-1).clip(-self.CLIP, self.CLIP)
        return np.concatenate([state.qpos[:, :1], np.sin(angles), np.cos(angles), clipped], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`survive`, less `distance` of the tip from upright and `velocity` of the joints."""
        x, height = after.derived["site_xpos"][:, 0, 0], after.derived["site_xpos"][:, 0, 2]
        lower, upper = after.qvel[:, 1], after.qvel[:, 2]
        survive = (~self.terminated(after)).astype(np.float64) * self.SURVIVE
        distance = 0.01 * np.square(x) + np.square(height - 2)
        velocity = 1e-3 * np.square(lower) + 5e-3 * np.square(upper)
        return Reward(
            survive - distance - velocity, {"survive": survive, "distance": -distance, "velocity": -velocity}
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """The upper tip at a height of 1 m or less."""
        return state.derived["site_xpos"][:, 0, 2] <= self.LEAST_HEIGHT


TASKS = (
    InvertedPendulum(
        id="InvertedPendulum-v5",
        horizon=1000,
        scene=asset("inverted_pendulum.xml"),
        control_step=0.02 * 2,
        frame_skip=2,
        start_noise=0.01,
        action_low=(-3.0,),
        action_high=(3.0,),
    ),
    InvertedDoublePendulum(
        id="InvertedDoublePendulum-v5",
        horizon=1000,
        scene=asset("inverted_double_pendulum.xml"),
        control_step=0.01 * 5,
        frame_skip=5,
        start_noise=0.1,
        normal_velocities=True,
        derived=("site_xpos", "qfrc_constraint"),
        action_low=(-1.0,),
        action_high=(1.0,),
    ),
)
