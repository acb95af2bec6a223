"""The cart-pole: a uniform pole hinged on a cart that a force pushes along a rail.

Barto, Sutton and Anderson's constants (IEEE Trans. SMC 13, 1983). With M the cart's mass, m and l the pole's
mass and half length, θ = 0 upright and D = 4M + m + 3m sin²θ:

    ẍ = (4F − 3mg sin θ cos θ + 4ml sin θ ω²)/D
    θ̈ = 3((M + m) g sin θ − F cos θ − ml sin θ cos θ ω²)/(l D)
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
NOISE = Noise(velocity=0.01)  # small, as every motor shakes a little
MAX_FORCE = 10.0  # N
PHYSICS_STEP = 0.0134  # s
POLE_LENGTH = 1.0  # m, hinge to tip
START = 0.05  # half width of the start in m, rad, m/s, rad/s
RAIL = 2.4  # m, half length
BALANCE_LIMIT = math.radians(12)  # beyond it balancing has failed
TIP_WIDTH = 0.25  # m, width of the swing-up reward's bell around the upright tip
EFFORT_WEIGHT = 0.001  # reward at the strongest force


@dataclass(frozen=True, kw_only=True)
class CartPole(Task):
    """What the two cart-pole tasks share: the system, and the observation (x, cos θ, sin θ, ẋ, ω)."""

    action_low: tuple[float, ...] = (-MAX_FORCE,)
    action_high: tuple[float, ...] = (MAX_FORCE,)
    noise: Noise = NOISE
    scene: Path = MODEL

    def physics(self, copies: int, threads: int) -> MujocoPhysics:
        """MuJoCo's cart-pole under Runge-Kutta's fourth-order rule."""
        return MujocoPhysics.of_ours(MODEL, self.control_step, PHYSICS_STEP, copies, threads)

    def observation(self, state: State) -> Float[np.ndarray, "B 5"]:
        """(x in m, cos θ, sin θ, ẋ in m/s, ω in rad/s)."""
        x, θ = state.qpos[:, :1], state.qpos[:, 1:]
        return np.concatenate([x, np.cos(θ), np.sin(θ), state.qvel], axis=-1)


class Balance(CartPole):
    """Keep the pole from falling and the cart on its rail."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "R 2"]]:
        """Upright: x, θ, ẋ and ω uniform in [−0.05, 0.05)."""
        states = draws.uniform(-START, START, 4)
        return states[:, :2], states[:, 2:]

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`alive`: one for each step."""
        return Reward.of(alive=np.ones(len(after.qpos)))

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """|x| > 2.4 m or |θ| > 12°."""
        return np.any(np.abs(state.qpos) > (RAIL, BALANCE_LIMIT), axis=-1)


class SwingUp(CartPole):
    """Swing the hanging pole up and hold its tip above the middle of the rail."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "R 2"]]:
        """Hanging: (x, θ − π, ẋ, ω) uniform in [−0.05, 0.05)."""
        states = draws.uniform(-START, START, 4)
        return states[:, :2] + (0.0, math.pi), states[:, 2:]

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`tip` exp(−½‖tip − (0, 1)‖²/0.25²) and `effort` −0.001 (F/10)²."""
        x, θ = after.qpos.T
        across, short = x + POLE_LENGTH * np.sin(θ), POLE_LENGTH * (np.cos(θ) - 1)
        return Reward.of(
            tip=np.exp((np.square(across) + np.square(short)) / (-2 * TIP_WIDTH**2)),
            effort=np.square(action[:, 0]) * (-EFFORT_WEIGHT / MAX_FORCE**2),
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """|x| > 2.4 m."""
        return np.abs(state.qpos[:, 0]) > RAIL


TASKS = (
    Balance(id="cartpole-balance", horizon=500, control_step=0.02),
    SwingUp(id="cartpole-swingup", horizon=250, control_step=0.04),
)
