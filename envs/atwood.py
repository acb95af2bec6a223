"""The swinging Atwood's machine: a bob that swings on a rope over pulleys, held by a counterweight.

With r the rope's free length, θ = 0 straight down, m = 1 the bob's mass, M = 2 the counterweight's, and u a
force that pulls the counterweight down and so shortens r (Tufillaro, Abbott and Griffiths, Am. J. Phys. 52,
1984):

    (M + m) r̈ = m r θ̇² + m g cos θ − M g − u
    r θ̈ = −g sin θ − 2 ṙ θ̇
"""

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from envs.physics import MujocoPhysics, State
from envs.streams import StartDraws
from envs.task import Noise, Reward, Task

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

MODEL = Path(__file__).with_suffix(".xml")
NOISE = Noise(velocity=0.01)  # small, as every motor shakes a little
GRAVITY = 9.81  # m/s²
MAX_FORCE = 10.0  # N
PHYSICS_STEP = 0.0125  # s
LENGTHS = (0.3, 3.0)  # m, outside of them an episode ends
TARGET_LENGTH = 1.0  # m
SWING_AMPLITUDE = math.pi / 3  # rad, of the swing to keep up
SWING_ENERGY = GRAVITY * TARGET_LENGTH * (1 - math.cos(SWING_AMPLITUDE))  # J per kg of the bob
LENGTH_WEIGHT = 0.5  # reward per m²
EFFORT_WEIGHT = 0.001  # reward per N²
SETTLE_START = (math.pi / 3, 1.5)  # rad, m: middle of the start of settling
SETTLE_SPREAD = 0.1  # rad and m, half width of that start
SETTLE_WIDTHS = (0.5, 0.3)  # rad, m: widths of the settling reward's bell
ROPE = 2.9  # m from the bob's pivot over the pulleys to the counterweight, as drawn


@dataclass(frozen=True, kw_only=True)
class Atwood(Task):
    """What both tasks share: the machine, and the observation (cos θ, sin θ, r, θ̇, ṙ)."""

    control_step: float = 0.05
    action_low: tuple[float, ...] = (-MAX_FORCE,)
    action_high: tuple[float, ...] = (MAX_FORCE,)
    noise: Noise = NOISE
    scene: Path = MODEL

    def physics(self, copies: int, threads: int) -> MujocoPhysics:
        """MuJoCo's machine under Runge-Kutta's fourth-order rule."""
        return MujocoPhysics.of_ours(MODEL, self.control_step, PHYSICS_STEP, copies, threads)

    def observation(self, state: State) -> Float[np.ndarray, "B 5"]:
        """(cos θ, sin θ, r in m, θ̇ in rad/s, ṙ in m/s)."""
        θ, r = state.qpos[:, :1], state.qpos[:, 1:]
        return np.concatenate([np.cos(θ), np.sin(θ), r, state.qvel], axis=-1)

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """The length outside [0.3, 3] m."""
        r = state.qpos[:, 1]
        return (r < LENGTHS[0]) | (r > LENGTHS[1])

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> None:
        """Bob and counterweight; the rope keeps its length."""
        data.qpos[:] = qpos
        data.mocap_pos[0, 2] = qpos[1] - ROPE


class Swing(Atwood):
    """Keep up a swing of amplitude π/3 at length 1 m."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "R 2"]]:
        """At rest: r uniform in [0.8, 1.2), θ in [−π/3, π/3)."""
        r = draws.uniform(0.8, 1.2, 1)
        θ = draws.uniform(-SWING_AMPLITUDE, SWING_AMPLITUDE, 1)
        qpos = np.concatenate([θ, r], axis=-1)
        return qpos, np.zeros_like(qpos)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`swing` exp(−(E/E_ref − 1)²), `length` −0.5 (r − 1)² and `effort` −0.001 u².

        E = ½ r² θ̇² + g r (1 − cos θ) is the swing's energy.
        """
        θ, r = after.qpos.T
        energy = 0.5 * np.square(r * after.qvel[:, 0]) + GRAVITY * r * (1 - np.cos(θ))
        return Reward.of(
            swing=np.exp(-np.square(energy / SWING_ENERGY - 1)),
            length=np.square(r - TARGET_LENGTH) * -LENGTH_WEIGHT,
            effort=np.square(action[:, 0]) * -EFFORT_WEIGHT,
        )


class Settle(Atwood):
    """Take in rope to length 1 m while the swing dies out."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "R 2"]]:
        """At rest around θ = π/3, r = 1.5 m, uniform within ±0.1 of each."""
        qpos = SETTLE_START + draws.uniform(-SETTLE_SPREAD, SETTLE_SPREAD, 2)
        return qpos, np.zeros_like(qpos)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`settled` exp(−(r − 1)²/(2·0.3²) − θ²/(2·0.5²))."""
        θ, r = after.qpos.T
        widths = SETTLE_WIDTHS
        far = np.square(θ / widths[0]) + np.square((r - TARGET_LENGTH) / widths[1])
        return Reward.of(settled=np.exp(-0.5 * far))


TASKS = (
    Swing(id="atwood", horizon=200),
    Settle(id="atwood-settle", horizon=200),
)
