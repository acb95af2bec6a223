"""What Gymnasium's MuJoCo tasks share: their models, their way to draw starts, and NumPy's way to add.

Observations, rewards, terminations and truncations equal those of `gymnasium.make(id)` bit for bit in
float64, which takes more than the same formulae: Gymnasium squares float32 actions in float32, and NumPy adds
numbers in another order than torch.
"""

import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

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


def squares(action: Float[Tensor, "B da"]) -> Float[Tensor, " B"]:
    """Σ a² in float32 and in NumPy's order, float32."""
    return torch.from_numpy(np.add.reduce(np.square(action.float().numpy()), axis=-1))


def numpy_sum(values: Float[Tensor, "B ..."]) -> Float[Tensor, " B"]:
    """The sum over all but the first dimension, in NumPy's order."""
    return torch.from_numpy(values.flatten(1).numpy().sum(axis=-1))


def norm(vectors: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """Lengths as `np.linalg.norm` finds them one by one, with the dot product of a BLAS."""
    rows = vectors.numpy()
    return torch.from_numpy(np.sqrt((rows[:, None, :] @ rows[:, :, None])[:, 0, 0]))


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

    def start(self, draws: StartDraws) -> tuple[Float[Tensor, "R nq"], Float[Tensor, "R nv"]]:
        """The model's initial state with noise, drawn as Gymnasium draws it."""
        qpos, qvel = zip(*(self.start_one(rng) for rng in draws.generators), strict=True)
        return torch.from_numpy(np.stack(qpos)), torch.from_numpy(np.stack(qvel))

    def start_one(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions [nq] and velocities [nv] of one start."""
        model, noise = shared(self.scene), self.start_noise
        qpos = model.qpos0 + rng.uniform(-noise, noise, model.nq)
        if self.normal_velocities:
            return qpos, noise * rng.standard_normal(model.nv)
        return qpos, rng.uniform(-noise, noise, model.nv)
