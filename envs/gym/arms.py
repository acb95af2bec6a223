"""Gymnasium's arms: Reacher and Pusher."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from envs.gym.base import GymnasiumTask, asset, norm, shared, squares
from envs.physics import State
from envs.task import Reward


@dataclass(frozen=True, kw_only=True)
class Arm(GymnasiumTask):
    """What the arms share: they look at where bodies are."""

    start_noise: float = 0.005  # of velocities, rad/s
    derived: tuple[str, ...] = ("xpos",)

    def place_of(self, body: str, state: State) -> Float[np.ndarray, "B 3"]:
        """Where a body is, m."""
        return state.derived["xpos"][:, shared(self.scene).body(body).id]


@dataclass(frozen=True, kw_only=True)
class Reacher(Arm):
    """Bring the fingertip of two links to a target that changes from episode to episode."""

    GOAL_RADIUS = 0.2  # m

    def start_one(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """An arm nearly straight, and a target within reach."""
        model = shared(self.scene)
        qpos = rng.uniform(-0.1, 0.1, model.nq) + model.qpos0
        goal = rng.uniform(-self.GOAL_RADIUS, self.GOAL_RADIUS, 2)
        while np.linalg.norm(goal) >= self.GOAL_RADIUS:
            goal = rng.uniform(-self.GOAL_RADIUS, self.GOAL_RADIUS, 2)
        qpos[-2:] = goal
        qvel = rng.uniform(-self.start_noise, self.start_noise, model.nv)
        qvel[-2:] = 0
        return qpos, qvel

    def observation(self, state: State) -> Float[np.ndarray, "B 10"]:
        """Cosines and sines of the joints, target, joint velocities, and the way from target to fingertip."""
        angles = state.qpos[:, :2]
        way = self.place_of("fingertip", state) - self.place_of("target", state)
        seen = [np.cos(angles), np.sin(angles), state.qpos[:, 2:], state.qvel[:, :2], way[:, :2]]
        return np.concatenate(seen, axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 2"], after: State) -> Reward:
        """Minus `dist` in m, minus `ctrl`."""
        distance = norm(self.place_of("fingertip", after) - self.place_of("target", after))
        return Reward.of(dist=-distance, ctrl=-squares(action))


@dataclass(frozen=True, kw_only=True)
class Pusher(Arm):
    """Push a cylinder to a goal with an arm of seven joints."""

    NEAR_WEIGHT = 0.5  # reward per m between hand and cylinder
    CONTROL_WEIGHT = 0.1  # reward per (N m)²
    CLEARANCE = 0.17  # m, least distance between cylinder and goal at the start

    def start_one(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The arm at rest, the cylinder anywhere that is not too near to the goal."""
        model = shared(self.scene)
        qpos = model.qpos0.copy()
        cylinder = np.zeros(2)
        while np.linalg.norm(cylinder) <= self.CLEARANCE:
            cylinder = np.concatenate([rng.uniform(-0.3, 0, 1), rng.uniform(-0.2, 0.2, 1)])
        qpos[-4:] = [*cylinder, 0, 0]
        qvel = rng.uniform(-self.start_noise, self.start_noise, model.nv)
        qvel[-4:] = 0
        return qpos, qvel

    def observation(self, state: State) -> Float[np.ndarray, "B 23"]:
        """Positions and velocities of the joints, and where hand, cylinder and goal are."""
        places = [self.place_of(body, state) for body in ("tips_arm", "object", "goal")]
        return np.concatenate([state.qpos[:, :7], state.qvel[:, :7], *places], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 7"], after: State) -> Reward:
        """Minus `dist` of the cylinder from the goal, `ctrl`, and `near`: the hand from the cylinder."""
        hand, cylinder, goal = (self.place_of(body, after) for body in ("tips_arm", "object", "goal"))
        return Reward.of(
            dist=-norm(cylinder - goal),
            ctrl=squares(action) * -self.CONTROL_WEIGHT,
            near=norm(cylinder - hand) * -self.NEAR_WEIGHT,
        )


TASKS = (
    Reacher(
        id="Reacher-v5",
        horizon=50,
        scene=asset("reacher.xml"),
        control_step=0.01 * 2,
        frame_skip=2,
        action_low=(-1.0,) * 2,
        action_high=(1.0,) * 2,
    ),
    Pusher(
        id="Pusher-v5",
        horizon=100,
        scene=asset("pusher_v5.xml"),
        control_step=0.01 * 5,
        frame_skip=5,
        action_low=(-2.0,) * 7,
        action_high=(2.0,) * 7,
    ),
)
