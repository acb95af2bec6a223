"""The inverted pendulum: a point mass on a massless rod, driven by a torque at the hinge.

θ̈ = (g/l) sin θ − b ω/(m l²) + u/(m l²), with θ = 0 upright. The torque is weaker than gravity's m g l, so
swinging up needs pumping. The model lies in `pendulum.xml`; mass, length and friction are read there.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from envs.physics import MujocoPhysics, State
from envs.streams import StartDraws
from envs.task import Noise, Plane, Reward, Task

MODEL = Path(__file__).with_suffix(".xml")
MAX_TORQUE = 5.0  # N m
PHYSICS_STEP = 0.025  # s
EFFORT_WEIGHT = 0.001  # reward per (N m)²
HANGING_STD = 0.1  # rad, spread of the start around hanging
BALANCE_START = 0.2  # rad and rad/s, half width of the start around upright
BALANCE_LIMIT = math.pi / 4  # rad, beyond it balancing has failed
BALANCE_WIDTHS = (0.3, 2.0)  # rad, rad/s: the widths of the reward's bell
EXPLORE_WIDTHS = (0.5, 2.0)  # rad, rad/s


def angle(state: State) -> Float[np.ndarray, " B"]:
    """The angle from upright in [−π, π)."""
    return np.remainder(state.qpos[:, 0] + math.pi, 2 * math.pi) - math.pi


def bell(state: State, widths: tuple[float, float]) -> Float[np.ndarray, " B"]:
    """exp(−θ²/(2 w_θ²) − ω²/(2 w_ω²)): one at rest upright, almost zero elsewhere."""
    θ, ω = angle(state), state.qvel[:, 0]
    return np.exp(-np.square(θ) / (2 * widths[0] ** 2) - np.square(ω) / (2 * widths[1] ** 2))


def _to_observation(points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    θ, ω = points.unbind(-1)
    return torch.stack([θ.cos(), θ.sin(), ω], dim=-1)


def _from_observation(observation: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    cosine, sine, ω = observation.unbind(-1)
    return torch.stack([torch.atan2(sine, cosine), ω], dim=-1)


PLANE = Plane(
    labels=("angle from upright θ (rad)", "angular velocity ω (rad/s)"),
    low=(-math.pi, -8.0),
    high=(math.pi, 8.0),
    to_observation=_to_observation,
    from_observation=_from_observation,
)


@dataclass(frozen=True, kw_only=True)
class Pendulum(Task):
    """What the three pendulum tasks share: the system, and the observation (cos θ, sin θ, ω)."""

    control_step: float = 0.05
    action_low: tuple[float, ...] = (-MAX_TORQUE,)
    action_high: tuple[float, ...] = (MAX_TORQUE,)
    plane: Plane | None = PLANE
    scene: Path = MODEL

    def physics(self, copies: int, threads: int) -> MujocoPhysics:
        """MuJoCo's pendulum under Runge-Kutta's fourth-order rule."""
        return MujocoPhysics.of_ours(MODEL, self.control_step, PHYSICS_STEP, copies, threads)

    def observation(self, state: State) -> Float[np.ndarray, "B 3"]:
        """(cos θ, sin θ, ω in rad/s)."""
        return np.concatenate([np.cos(state.qpos), np.sin(state.qpos), state.qvel], axis=-1)


class Hanging(Pendulum):
    """Pendulum tasks that start at rest, hanging."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 1"], Float[np.ndarray, "R 1"]]:
        """θ ~ N(π, 0.1²), ω = 0."""
        qpos = math.pi + draws.normal(HANGING_STD, 1)
        return qpos, np.zeros_like(qpos)


class SwingUp(Hanging):
    """Swing up and stay there, with little torque."""

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`upright` (1 + cos θ)/2 and `effort` −0.001 u²."""
        return Reward.of(
            upright=0.5 + 0.5 * np.cos(after.qpos[:, 0]),
            effort=np.square(action[:, 0]) * -EFFORT_WEIGHT,
        )


class Explore(Hanging):
    """Swing up on a reward that is almost zero until upright: a test of exploration."""

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`upright` exp(−θ²/(2·0.5²) − ω²/(2·2²))."""
        return Reward.of(upright=bell(after, EXPLORE_WIDTHS))


class Balance(Pendulum):
    """Stay upright."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 1"], Float[np.ndarray, "R 1"]]:
        """θ and ω uniform in [−0.2, 0.2)."""
        states = draws.uniform(-BALANCE_START, BALANCE_START, 2)
        return states[:, :1], states[:, 1:]

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`upright` exp(−θ²/(2·0.3²) − ω²/(2·2²))."""
        return Reward.of(upright=bell(after, BALANCE_WIDTHS))

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """|θ| > π/4."""
        return np.abs(angle(state)) > BALANCE_LIMIT


TASKS = (
    SwingUp(id="pendulum-swingup", horizon=200, noise=Noise(velocity=0.01)),
    Balance(id="pendulum-balance", horizon=100, noise=Noise(velocity=0.01)),
    Explore(id="pendulum-explore", horizon=100),
)
