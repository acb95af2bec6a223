"""The crane: carry a load that swings below a trolley to a goal, and bring it to rest there.

With M the trolley's mass, m the load's, l the rope's length, θ = 0 hanging and D = M + m sin²θ:

    ẍ = (F + mg sin θ cos θ + ml sin θ ω²)/D
    θ̈ = −((M + m) g sin θ + F cos θ + ml sin θ cos θ ω²)/(l D)
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from envs.physics import MujocoPhysics, State
from envs.streams import StartDraws
from envs.task import Noise, Reward, Task

MODEL = Path(__file__).with_suffix(".xml")
MAX_FORCE = 10.0  # N
PHYSICS_STEP = 0.025  # s
ROPE = 0.8  # m
GOAL = 1.0  # m, where the load shall hang
START, START_SPREAD = -1.0, 0.1  # m, middle and half width of the trolley's start
RAIL = 1.6  # m, half length
SWING_LIMIT = math.pi / 2  # rad, beyond it the rope would slacken
WEIGHTS = {"distance": 1.0, "swing": 0.5, "swing_rate": 0.1, "speed": 0.05, "effort": 0.001}  # of squares


@dataclass(frozen=True, kw_only=True)
class Crane(Task):
    """Carry the load to the goal; the observation is (x − goal, cos θ, sin θ, ẋ, ω)."""

    action_low: tuple[float, ...] = (-MAX_FORCE,)
    action_high: tuple[float, ...] = (MAX_FORCE,)
    scene: Path = MODEL

    def physics(self, copies: int, threads: int) -> MujocoPhysics:
        """MuJoCo's crane under Runge-Kutta's fourth-order rule."""
        return MujocoPhysics.of_ours(MODEL, self.control_step, PHYSICS_STEP, copies, threads)

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "R 2"]]:
        """At rest with a still load: x uniform in [−1.1, −0.9)."""
        x = START + draws.uniform(-START_SPREAD, START_SPREAD, 1)
        qpos = np.concatenate([x, np.zeros_like(x)], axis=-1)
        return qpos, np.zeros_like(qpos)

    def observation(self, state: State) -> Float[np.ndarray, "B 5"]:
        """(x − goal in m, cos θ, sin θ, ẋ in m/s, ω in rad/s)."""
        x, θ = state.qpos[:, :1], state.qpos[:, 1:]
        return np.concatenate([x - GOAL, np.cos(θ), np.sin(θ), state.qvel], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """−(e² + 0.5 θ² + 0.1 ω² + 0.05 ẋ² + 0.001 F²), e the load's distance to the goal along the rail."""
        (x, θ), (speed, ω) = after.qpos.T, after.qvel.T
        e = x + ROPE * np.sin(θ) - GOAL
        errors = {"distance": e, "swing": θ, "swing_rate": ω, "speed": speed, "effort": action[:, 0]}
        return Reward.of(**{name: np.square(error) * -WEIGHTS[name] for name, error in errors.items()})

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """|x| > 1.6 m or |θ| > π/2."""
        return np.any(np.abs(state.qpos) > (RAIL, SWING_LIMIT), axis=-1)


TASKS = (Crane(id="crane", horizon=200, control_step=0.05, noise=Noise(velocity=0.01)),)
