"""What a task is: pure batched functions of the state, and the numbers that fix the problem.

A task holds no state and steps no simulator: `physics.py` moves the state, `copies.py` calls the functions
here once a control step, `batch.py` wraps the results for TorchRL. The functions are NumPy's, as
the simulator's memory is: right after MuJoCo's step, with cold caches, an operation in torch costs several
times as much.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

import abc
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from envs.physics import Physics, State
from envs.streams import StartDraws


class Reward(NamedTuple):
    """A reward [B] and its named parts [B], for plots and for finding out what an agent is after."""

    total: NDArray[np.floating]
    parts: dict[str, NDArray[np.floating]]

    @classmethod
    def of(cls, **parts: NDArray[np.floating]) -> "Reward":
        """The sum of the parts, in the order given."""
        return cls(functools.reduce(np.add, parts.values()), parts)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the normal noise of each control step."""

    observation: float = 0.0  # added to every entry of the observation, in its unit
    action: float = 0.0  # added to the action before it is clipped to the actuator's bounds, in its unit
    velocity: float = 0.0  # added to every generalised velocity after the step, m/s or rad/s


@dataclass(frozen=True)
class Plane:
    """A picture plane: two coordinates that fix the whole observation, for maps of value functions.

    Attributes:
        labels: names of the coordinates, with units.
        low, high: the range to draw.
        to_observation: points [..., 2] -> observations [..., do].
        from_observation: observations [..., do] -> points [..., 2].
    """

    labels: tuple[str, str]
    low: tuple[float, float]
    high: tuple[float, float]
    to_observation: Callable[[Tensor], Tensor]
    from_observation: Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Task(abc.ABC):
    """A control problem. Subclasses define the functions, instances the numbers."""

    id: str
    horizon: int  # control steps until an episode is truncated
    control_step: float  # s between actions
    action_low: tuple[float, ...]  # bounds of the actuators, in their units
    action_high: tuple[float, ...]
    noise: Noise = field(default_factory=Noise)
    plane: Plane | None = None
    scene: Path  # the MuJoCo model to draw

    @abc.abstractmethod
    def physics(self, copies: int, threads: int) -> Physics:
        """A simulator of `copies` independent copies on `threads` threads."""

    @abc.abstractmethod
    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R nq"], Float[np.ndarray, "R nv"]]:
        """Draw the positions and velocities that R episodes start from."""

    @abc.abstractmethod
    def observation(self, state: State) -> Float[np.ndarray, "B do"]:
        """What the agent sees, in a new array."""

    @abc.abstractmethod
    def reward(self, before: State, action: Float[np.ndarray, "B da"], after: State) -> Reward:
        """The reward of a step, from the states around it and the action that was applied."""

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> None:
        """Put positions [nq] into the model that is drawn, with whatever only the eye needs."""
        data.qpos[:] = qpos

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """Where the episode is over for good, time limits aside; never, unless a task says otherwise."""
        return np.zeros(len(state.qpos), dtype=bool)
