"""What Gymnasium's MuJoCo tasks share: their models and their way to draw starts.

Observations, rewards, terminations and truncations equal those of `gymnasium.make(id)` bit for bit in
float64, which takes more than the same formulae: Gymnasium squares float32 actions in float32, and a sum of
numbers depends on their order.
"""

import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from envs.models import load
from envs.physics import MujocoPhysics, Physics
from envs.streams import StartDraws
from envs.task import Task

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)


def asset(file: str) -> Path:
    """Path of a model that Gymnasium brings along."""
    spec = importlib.util.find_spec("gymnasium.envs.mujoco")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "assets" / file


@functools.cache
def shared(path: Path) -> mujoco.MjModel:
    """The model of a file, read once; nobody may write to it."""
    return load(path)


def squares(action: Float[np.ndarray, "B da"]) -> Float[np.ndarray, " B"]:
    """Σ a² in float32, as Gymnasium's actions are."""
    return np.add.reduce(np.square(action.astype(np.float32)), axis=-1)


def norm(vectors: Float[np.ndarray, "B n"]) -> Float[np.ndarray, " B"]:
    """Lengths as `np.linalg.norm` finds them one by one, with the dot product of a BLAS."""
    return np.sqrt((vectors[:, None, :] @ vectors[:, :, None])[:, 0, 0])


@dataclass(frozen=True, kw_only=True)
class GymnasiumTask(Task):
    """A task of Gymnasium on one of its MuJoCo models.

    The bounds of actions are those of Gymnasium's action spaces, which are float32.
    """

    frame_skip: int  # physics steps in a control step
    start_noise: float  # half width, or standard deviation, of the noise of the start, m or rad and per s
    normal_velocities: bool = False  # draw the start's velocities from a normal distribution, else uniformly
    derived: tuple[str, ...] = ()  # fields of MjData that the task reads beside positions and velocities

    def physics(self, copies: int, threads: int) -> Physics:
        """Gymnasium's model, as it is."""
        return MujocoPhysics(shared(self.scene), copies, self.frame_skip, threads, self.derived)

    def start(self, draws: StartDraws) -> tuple[Float[np.ndarray, "R nq"], Float[np.ndarray, "R nv"]]:
        """The model's initial state with noise, drawn as Gymnasium draws it."""
        qpos, qvel = zip(*(self.start_one(rng) for rng in draws.generators), strict=True)
        return np.stack(qpos), np.stack(qvel)

    def start_one(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions [nq] and velocities [nv] of one start."""
        model, noise = shared(self.scene), self.start_noise
        qpos = model.qpos0 + rng.uniform(-noise, noise, model.nq)
        if self.normal_velocities:
            return qpos, noise * rng.standard_normal(model.nv)
        return qpos, rng.uniform(-noise, noise, model.nv)
