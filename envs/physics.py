"""The simulators: B copies of one system, advanced together over one shared array.

MuJoCo's `Batch` steps all copies over one `(B, nstate)` float64 array, bit for bit as a loop over single
simulations would, on any number of threads.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

import abc
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from envs.models import stripped

LARGEST = 1e10  # beyond it MuJoCo calls a state divergent (mjMAXVAL)
TOO_LARGE = f"a number that is not finite or beyond {LARGEST:g}"
BAD_STATE = {  # what makes MuJoCo reset a simulation
    int(mujoco.mjtWarning.mjWARN_BADQPOS): "a bad position",
    int(mujoco.mjtWarning.mjWARN_BADQVEL): "a bad velocity",
    int(mujoco.mjtWarning.mjWARN_BADQACC): "a bad acceleration",
}


Floats = NDArray[np.float64]


class State(NamedTuple):
    """The state of B simulations.

    Attributes:
        qpos: [B, nq] generalised positions, m or rad.
        qvel: [B, nv] generalised velocities, m/s or rad/s.
        derived: what the task asked of the simulator beyond them, name -> [B, ...].
    """

    qpos: Floats
    qvel: Floats
    derived: Mapping[str, Floats] = {}


class Divergence(NamedTuple):
    """Simulations that were lost.

    Attributes:
        copies: [B] which.
        reason: what went wrong in the first of them.
    """

    copies: NDArray[np.bool_]
    reason: str


class Physics(abc.ABC):
    """B copies of a system.

    Attributes:
        qpos: [B, nq] float64, a live view of the simulator's memory; copy it to keep it.
        qvel: [B, nv] float64, likewise.
        derived: further live views, name -> [B, ...].
        rows: [B, n] float64, a live view of all that the future depends on.
        control: [B, nu] float64, a live view of what acts during the next step: write to it.
    """

    rows: Floats
    control: Floats
    qpos: Floats
    qvel: Floats
    derived: dict[str, Floats]

    @abc.abstractmethod
    def advance(self) -> State:
        """Advance every copy by one control step under the present `control`.

        Returns:
            The state before the step, valid until the next one.
        """

    @abc.abstractmethod
    def place(
        self, rows: NDArray[np.intp], qpos: Float[np.ndarray, "R nq"], qvel: Float[np.ndarray, "R nv"]
    ) -> None:
        """Put the copies `rows` [R] into new states, [R, nq] and [R, nv], and forget their past."""

    @abc.abstractmethod
    def diverged(self) -> Divergence | None:
        """Where and why the last step ended in no usable state, or None where all is well."""

    @abc.abstractmethod
    def restore(self, rows: Bool[np.ndarray, " B"]) -> None:
        """Undo the last step of the copies `rows`."""


class MujocoPhysics(Physics):
    """Copies of a MuJoCo model.

    Args:
        model: the model to step.
        copies: how many, B.
        substeps: physics steps in a control step.
        threads: threads to step on; results do not depend on it.
        derived: names of MjData fields to keep beside positions and velocities; as after `mj_step`, they
            lag behind by one physics step.
        persistent: keep one MjData per copy, for fields that the batch itself does not bind.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        copies: int,
        substeps: int,
        threads: int,
        derived: tuple[str, ...] = (),
        persistent: bool = False,
    ) -> None:
        self.model = model
        self.batch = mujoco.batch.Batch(model, copies, nthread=threads, persistent=persistent)
        self.substeps = substeps
        self.rows = self.batch.state
        self._before = self.rows.copy()
        qpos, qvel, control = (self._columns(name) for name in ("qpos", "qvel", "ctrl"))
        self.qpos, self.qvel, self.control = self.rows[:, qpos], self.rows[:, qvel], self.rows[:, control]
        self.derived = {name: self.batch.bind(name) for name in derived}
        for value in self.derived.values():
            # MuJoCo overwrites these at each call; they are written only to go back to an earlier state.
            value.flags.writeable = True
        self._past_derived = {name: value.copy() for name, value in self.derived.items()}
        self._past = State(self._before[:, qpos], self._before[:, qvel], self._past_derived)

    @classmethod
    def of_ours(
        cls, path: Path, control_step: float, physics_step: float, copies: int, threads: int
    ) -> "MujocoPhysics":
        """Copies of one of our own models, `stripped`, with physics steps of at most `physics_step` s."""
        model = stripped(path)
        substeps = math.ceil(control_step / physics_step - 1e-9)  # the quotient of equal steps may round up
        model.opt.timestep = control_step / substeps
        return cls(model, copies, substeps, threads)

    def _columns(self, field: str) -> slice:
        """Where a field of MjData lies in the state rows."""
        view = self.batch.bind(field)
        first = (view.ctypes.data - self.batch.state.ctypes.data) // view.itemsize
        return slice(first, first + view.shape[1])

    def advance(self) -> State:
        """Advance every copy by `substeps` physics steps; see `Physics.advance`."""
        np.copyto(self._before, self.rows)
        for name, value in self.derived.items():
            np.copyto(self._past_derived[name], value)
        self.batch.step(nstep=self.substeps)
        return self._past

    def place(
        self, rows: NDArray[np.intp], qpos: Float[np.ndarray, "R nq"], qvel: Float[np.ndarray, "R nv"]
    ) -> None:
        """Reset copies and compute what follows from their new states; see `Physics.place`."""
        self.batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[rows] = qpos
        self.qvel[rows] = qvel
        self.batch.forward(rows)

    def diverged(self) -> Divergence | None:
        """Where MuJoCo had to reset a copy, or left it beyond `LARGEST`; see `Physics.diverged`."""
        # A sum of squares within the bound's square proves all entries within the bound; NaN fails the test.
        if np.vdot(self.rows, self.rows) <= LARGEST**2 and not np.count_nonzero(self.batch.warning):
            return None
        lost = np.stack([self.batch.warning[:, warning, 1] > 0 for warning in BAD_STATE])
        self.batch.warning[:] = 0
        bad = lost.any(axis=0) | ~(np.abs(self.rows).max(axis=1) <= LARGEST)
        if not bad.any():
            return None
        reasons = np.array(list(BAD_STATE.values()))[lost[:, bad.argmax()]]
        return Divergence(bad, reasons[0] if len(reasons) else TOO_LARGE)

    def restore(self, rows: Bool[np.ndarray, " B"]) -> None:
        """Put back the state before the last step; see `Physics.restore`."""
        self.rows[rows] = self._before[rows]
        for name, value in self.derived.items():
            value[rows] = self._past_derived[name][rows]


class TorchPhysics(Physics):
    """Copies of a system given by its equations, as one batched function in torch.

    Args:
        transition: (qpos [B, nq], qvel [B, nv], control [B, nu]) -> the positions and velocities one control
            step later.
        copies: how many, B.
        sizes: nq, nv and nu.
    """

    def __init__(
        self,
        transition: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
        copies: int,
        sizes: tuple[int, int, int],
    ) -> None:
        self._transition = transition
        self.rows, self._before = np.zeros((copies, sum(sizes))), np.zeros((copies, sum(sizes)))
        bounds = np.cumsum(sizes)[:-1]
        self.qpos, self.qvel, self.control = np.split(self.rows, bounds, axis=1)
        past_qpos, past_qvel, _ = np.split(self._before, bounds, axis=1)
        self._past = State(past_qpos, past_qvel)
        self._inputs = torch.from_numpy(self._before).split(sizes, dim=1)  # the same memory
        self._outputs = torch.from_numpy(self.rows).split(sizes, dim=1)[:2]
        self.derived = {}

    def advance(self) -> State:
        """Apply the transition; see `Physics.advance`."""
        np.copyto(self._before, self.rows)
        for now, new in zip(self._outputs, self._transition(*self._inputs), strict=True):
            now.copy_(new)
        return self._past

    def place(
        self, rows: NDArray[np.intp], qpos: Float[np.ndarray, "R nq"], qvel: Float[np.ndarray, "R nv"]
    ) -> None:
        """Write the states; see `Physics.place`."""
        self.qpos[rows] = qpos
        self.qvel[rows] = qvel

    def diverged(self) -> Divergence | None:
        """Where a number is not finite or beyond `LARGEST`; see `Physics.diverged`."""
        sizes = np.abs(self.rows).max(axis=1)
        good = sizes <= LARGEST  # NaN fails the test
        return None if good.all() else Divergence(~good, TOO_LARGE)

    def restore(self, rows: Bool[np.ndarray, " B"]) -> None:
        """Put back the state before the last step; see `Physics.restore`."""
        self.rows[rows] = self._before[rows]
