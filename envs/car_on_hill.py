"""The car on the hill: too weak to climb straight away, it must first roll back.

Ernst, Geurts and Wehenkel, "Tree-based batch mode reinforcement learning", JMLR 6, 2005. A car of mass m = 1
moves along the profile H(p) = p² + p for p < 0, p/√(1 + 5p²) for p ≥ 0, with speed s along p:

    ṡ = u/(m(1 + H'²)) − g H'/(1 + H'²) − s² H' H''/(1 + H'²)

The equation has no exact form in MuJoCo; it is integrated here in torch.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from envs.physics import State, TorchPhysics
from envs.streams import StartDraws
from envs.task import Noise, Plane, Reward, Task

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

MODEL = Path(__file__).with_suffix(".xml")
GRAVITY = 9.81  # m/s²
MAX_FORCE = 4.0  # N
CONTROL_STEP = 0.1  # s
SUBSTEPS = 4  # of 0.025 s
NEWTON_STEPS = 2  # to find when a car passes the joint of the two curves
START = 0.1  # m, half width of the start around p = 0
ROAD = 1.0  # m: the goal lies beyond +1, the abyss beyond −1
TOP_SPEED = 3.0  # m/s, faster is a crash

Column = Float[Tensor, "B 1"]


def profile(p: Column) -> Column:
    """The hill's height H(p) in m."""
    return torch.where(p < 0, p * p + p, p / (1 + 5 * p * p).sqrt())


def slopes(p: Column, left: Bool[Tensor, "B 1"]) -> tuple[Column, Column]:
    """H' and H'' of the valley's parabola where `left`, else of the hilltop's curve.

    The two join at p = 0 with a common slope but a jump in H''.
    """
    inverse = (5 * p * p + 1).rsqrt()
    square = inverse * inverse
    slope = square * inverse  # H' = (1 + 5p²)^(−3/2), H'' = −15 p (1 + 5p²)^(−5/2)
    return torch.where(left, 2 * p + 1, slope), torch.where(left, 2.0, p * slope * square * -15)


def acceleration(p: Column, s: Column, u: Column, left: Bool[Tensor, "B 1"]) -> Column:
    """ṡ in m/s²."""
    first, second = slopes(p, left)
    return (u - first * (s * s * second + GRAVITY)) / (first * first + 1)


def runge_kutta(
    p: Column, s: Column, u: Column, h: Column | float, left: Bool[Tensor, "B 1"]
) -> tuple[Column, Column]:
    """Position and speed after `h` seconds on one side of the joint, by the classical fourth-order rule."""
    a1 = acceleration(p, s, u, left)
    s2 = s + h / 2 * a1
    a2 = acceleration(p + h / 2 * s, s2, u, left)
    s3 = s + h / 2 * a2
    a3 = acceleration(p + h / 2 * s2, s3, u, left)
    s4 = s + h * a3
    a4 = acceleration(p + h * s3, s4, u, left)
    return p + h / 6 * (s + 2 * s2 + 2 * s3 + s4), s + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def across(
    p: Column, s: Column, u: Column, h: float, end: Column, left: Bool[Tensor, "B 1"]
) -> tuple[Column, Column]:
    """As `runge_kutta`, for cars that pass the joint: up to it on one side, then on from it on the other.

    Without the split the jump in H'' would cost three digits. `end` is where the car would be without the
    jump, beyond the joint.
    """
    τ = h * p / (p - end)  # when the joint is passed: by the chord, then by Newton's rule
    there, speed = runge_kutta(p, s, u, τ, left)
    for _ in range(NEWTON_STEPS):
        τ = torch.where(there == 0, τ, (τ - there / speed).clamp(0, h))
        there, speed = runge_kutta(p, s, u, τ, left)
    return runge_kutta(there, speed, u, h - τ, ~left)


def transition(p: Column, s: Column, u: Column) -> tuple[Column, Column]:
    """A control step."""
    h = CONTROL_STEP / SUBSTEPS
    for _ in range(SUBSTEPS):
        left = p < 0
        new_p, new_s = runge_kutta(p, s, u, h, left)
        passed = ((new_p < 0) != left).squeeze(1)
        if passed.any():
            new_p[passed], new_s[passed] = across(
                p[passed], s[passed], u[passed], h, new_p[passed], left[passed]
            )
        p, s = new_p, new_s
    return p, s


def _unchanged(points: Tensor) -> Tensor:
    return points


PLANE = Plane(
    labels=("position p (m)", "speed s (m/s)"),
    low=(-ROAD, -TOP_SPEED),
    high=(ROAD, TOP_SPEED),
    to_observation=_unchanged,
    from_observation=_unchanged,
)


@dataclass(frozen=True, kw_only=True)
class CarOnHill(Task):
    """Reach the hilltop on the right, not the abyss on the left, and not too fast."""

    control_step: float = CONTROL_STEP
    action_low: tuple[float, ...] = (-MAX_FORCE,)
    action_high: tuple[float, ...] = (MAX_FORCE,)
    scene: Path = MODEL
    plane: Plane | None = PLANE

    def physics(self, copies: int, threads: int) -> TorchPhysics:
        """The equation of motion in torch; `threads` is not used."""
        return TorchPhysics(transition, copies, (1, 1, 1))

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 1"], Float[np.ndarray, "R 1"]]:
        """At rest: p uniform in [−0.1, 0.1)."""
        p = draws.uniform(-START, START, 1)
        return p, np.zeros_like(p)

    def observation(self, state: State) -> Float[np.ndarray, "B 2"]:
        """(p in m, s in m/s)."""
        return np.concatenate([state.qpos, state.qvel], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`goal` +1 beyond p = 1 with |s| ≤ 3; `crash` −1 beyond p = −1 or with |s| > 3."""
        p, s = after.qpos[:, 0], after.qvel[:, 0]
        too_fast = np.abs(s) > TOP_SPEED
        return Reward.of(
            goal=((p > ROAD) & ~too_fast).astype(np.float64),
            crash=-((p < -ROAD) | too_fast).astype(np.float64),
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """|p| > 1 m or |s| > 3 m/s."""
        return (np.abs(state.qpos[:, 0]) > ROAD) | (np.abs(state.qvel[:, 0]) > TOP_SPEED)

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> None:
        """The car on the road, level with it."""
        p = torch.from_numpy(qpos).reshape(1, 1)
        tilt = -np.arctan(slopes(p, p < 0)[0].item())
        data.mocap_pos[0] = (p.item(), 0, profile(p).item())
        data.mocap_quat[0] = (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)


TASKS = (CarOnHill(id="car-on-hill", horizon=100, noise=Noise(velocity=0.01)),)
