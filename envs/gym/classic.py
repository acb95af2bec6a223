"""Gymnasium's classic control with continuous actions: Pendulum and MountainCarContinuous.

Neither runs on MuJoCo in Gymnasium; both are maps from one step to the next, written here in torch.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from envs import pendulum
from envs.physics import State, TorchPhysics
from envs.streams import StartDraws
from envs.task import Plane, Reward, Task

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

MOUNTAIN_CAR_SCENE = Path(__file__).parents[1] / "mountain_car.xml"
Column = Float[Tensor, "B 1"]


def swing(θ: Column, ω: Column, torque: Column) -> tuple[Column, Column]:
    """A step of Pendulum-v1: a uniform rod of 1 kg and 1 m under g = 10 m/s², semi-implicit Euler."""
    sine = torch.from_numpy(np.sin(θ.numpy()))
    push = 3.0 * torque.float()  # in float32, as Gymnasium's torques are
    ω = (ω + (15.0 * sine + push) * Pendulum.STEP).clamp(-Pendulum.TOP_SPEED, Pendulum.TOP_SPEED)
    return θ + ω * Pendulum.STEP, ω


def drive(position: Column, velocity: Column, force: Column) -> tuple[Column, Column]:
    """A step of MountainCarContinuous-v0; its walls stop the car."""
    car = MountainCar
    velocity = velocity + force * car.POWER - car.GRAVITY * (3 * position).cos()
    velocity = velocity.clamp(-car.TOP_SPEED, car.TOP_SPEED)
    position = (position + velocity).clamp(*car.ROAD)
    return position, torch.where((position == car.ROAD[0]) & (velocity < 0), 0.0, velocity)


@dataclass(frozen=True, kw_only=True)
class Classic(Task):
    """What both share: two-dimensional states, and starts drawn as Gymnasium draws them."""

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R 1"], Float[np.ndarray, "R 1"]]:
        """Position and velocity."""
        states = np.stack([self.start_one(rng) for rng in draws.generators])
        return states[:, :1], states[:, 1:]

    def start_one(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Position and velocity of one start, [2]."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Pendulum(Classic):
    """Swing up a weakly driven rod and hold it, cheaply."""

    STEP = 0.05  # s
    TOP_SPEED = 8.0  # rad/s

    def physics(self, copies: int, threads: int) -> TorchPhysics:
        """Gymnasium's map in torch; `threads` is not used."""
        return TorchPhysics(swing, copies, (1, 1, 1))

    def start_one(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Any angle, up to 1 rad/s."""
        high = np.array([math.pi, 1.0])
        return rng.uniform(-high, high)

    def observation(self, state: State) -> Float[np.ndarray, "B 3"]:
        """(cos θ, sin θ, ω)."""
        return np.concatenate([np.cos(state.qpos), np.sin(state.qpos), state.qvel], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """Minus the squares of `angle` and `speed` before the step, and of the `effort`."""
        angle, speed = np.square(pendulum.angle(before)), np.square(before.qvel[:, 0])
        effort = np.square(action[:, 0].astype(np.float32))
        cost = angle + 0.1 * speed + 0.001 * effort
        return Reward(-cost, {"angle": -angle, "speed": -0.1 * speed, "effort": -0.001 * effort})


@dataclass(frozen=True, kw_only=True)
class MountainCar(Classic):
    """Drive a weak car out of a valley, cheaply."""

    POWER = 0.0015  # speed gained in a step at full force
    GRAVITY = 0.0025  # speed lost in a step on the steepest slope
    TOP_SPEED = 0.07  # per step
    ROAD = (-1.2, 0.6)
    GOAL = 0.45
    PRIZE = 100.0
    EFFORT_WEIGHT = 0.1

    def physics(self, copies: int, threads: int) -> TorchPhysics:
        """Gymnasium's map in torch; `threads` is not used."""
        return TorchPhysics(drive, copies, (1, 1, 1))

    def start_one(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """At rest, near the valley's lowest point."""
        return np.array([rng.uniform(-0.6, -0.4), 0.0])

    def observation(self, state: State) -> Float[np.ndarray, "B 2"]:
        """(position, velocity)."""
        return np.concatenate([state.qpos, state.qvel], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 1"], after: State) -> Reward:
        """`goal` 100 at the flag, less `effort` 0.1 F²."""
        return Reward.of(
            goal=self.terminated(after) * self.PRIZE,
            effort=np.square(action[:, 0]) * -self.EFFORT_WEIGHT,
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """The car has reached the flag, rolling forward."""
        return (state.qpos[:, 0] >= self.GOAL) & (state.qvel[:, 0] >= 0)

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> None:
        """The car on the hill sin 3p, level with it."""
        tilt = -np.arctan(3 * 0.45 * np.cos(3 * qpos[0]))
        data.mocap_pos[0] = (qpos[0], 0, 0.45 * np.sin(3 * qpos[0]) + 0.1)
        data.mocap_quat[0] = (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)


def _unchanged(points: Tensor) -> Tensor:
    return points


TASKS = (
    Pendulum(
        id="Pendulum-v1",
        horizon=200,
        control_step=Pendulum.STEP,
        action_low=(-2.0,),
        action_high=(2.0,),
        scene=pendulum.MODEL,
        plane=pendulum.PLANE,
    ),
    MountainCar(
        id="MountainCarContinuous-v0",
        horizon=999,
        control_step=1.0,
        action_low=(-1.0,),
        action_high=(1.0,),
        scene=MOUNTAIN_CAR_SCENE,
        plane=Plane(
            labels=("position", "velocity (per step)"),
            low=(MountainCar.ROAD[0], -MountainCar.TOP_SPEED),
            high=(MountainCar.ROAD[1], MountainCar.TOP_SPEED),
            to_observation=_unchanged,
            from_observation=_unchanged,
        ),
    ),
)
