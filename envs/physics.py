"""The simulators: B copies of one system, advanced together over one shared array.

MuJoCo's `Batch` steps all copies over one `(B, nstate)` float64 array, bit for bit as a loop over single
simulations would, on any number of threads; torch views the same memory.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

import abc
import math
import warnings
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


class State(NamedTuple):
    """The state of B simulations.

    Attributes:
        qpos: [B, nq] generalised positions, m or rad.
        qvel: [B, nv] generalised velocities, m/s or rad/s.
        derived: what the task asked of the simulator beyond them, name -> [B, ...].
    """

    qpos: Tensor
    qvel: Tensor
    derived: Mapping[str, Tensor] = {}


class Divergence(NamedTuple):
    """Simulations that were lost.

    Attributes:
        copies: [B] which.
        reason: what went wrong in the first of them.
    """

    copies: Tensor
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

    rows: Tensor
    control: Tensor
    qpos: Tensor
    qvel: Tensor
    derived: dict[str, Tensor]

    @abc.abstractmethod
    def advance(self) -> State:
        """Advance every copy by one control step under the present `control`.

        Returns:
            The state before the step, valid until the next one.
        """

    @abc.abstractmethod
    def place(self, rows: NDArray[np.intp], qpos: Float[Tensor, "R nq"], qvel: Float[Tensor, "R nv"]) -> None:
        """Put the copies `rows` into new states and forget their past."""

    @abc.abstractmethod
    def diverged(self) -> Divergence | None:
        """Where and why the last step ended in no usable state, or None where all is well."""

    @abc.abstractmethod
    def restore(self, rows: Bool[Tensor, " B"]) -> None:
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
        self.rows = torch.from_numpy(self.batch.state)
        self._before = self.rows.clone()
        qpos, qvel, control = (self._columns(name) for name in ("qpos", "qvel", "ctrl"))
        self.qpos, self.qvel, self.control = self.rows[:, qpos], self.rows[:, qvel], self.rows[:, control]
        with warnings.catch_warnings():
            # MuJoCo overwrites these at each call; they are written only to go back to an earlier state.
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")
            self.derived = {name: torch.from_numpy(self.batch.bind(name)) for name in derived}
        self._past_derived = {name: value.clone() for name, value in self.derived.items()}
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
        self._before.copy_(self.rows)
        for name, value in self.derived.items():
            self._past_derived[name].copy_(value)
        self.batch.step(nstep=self.substeps)
        return self._past

    def place(self, rows: NDArray[np.intp], qpos: Float[Tensor, "R nq"], qvel: Float[Tensor, "R nv"]) -> None:
        """Reset copies and compute what follows from their new states; see `Physics.place`."""
        self.batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        index = torch.from_numpy(rows)
        self.qpos[index] = qpos
        self.qvel[index] = qvel
        self.batch.forward(rows)

    def diverged(self) -> Divergence | None:
        """Where MuJoCo had to reset a copy, or left it beyond `LARGEST`; see `Physics.diverged`."""
        # A sum of squares within the bound's square proves all entries within the bound; NaN fails the test.
        state = self.batch.state
        if np.vdot(state, state) <= LARGEST**2 and not np.count_nonzero(self.batch.warning):
            return None
        lost = np.stack([self.batch.warning[:, warning, 1] > 0 for warning in BAD_STATE])
        self.batch.warning[:] = 0
        bad = lost.any(axis=0) | ~(np.abs(state).max(axis=1) <= LARGEST)
        if not bad.any():
            return None
        reasons = np.array(list(BAD_STATE.values()))[lost[:, bad.argmax()]]
        return Divergence(torch.from_numpy(bad), reasons[0] if len(reasons) else TOO_LARGE)

    def restore(self, rows: Bool[Tensor, " B"]) -> None:
        """Put back the state before the last step; see `Physics.restore`."""
        self.rows[rows] = self._before[rows]
        for name, value in self.derived.items():
            value[rows] = self._past_derived[name][rows]


class TorchPhysics(Physics):
    """Copies of a system given by its equations, as one batched function.

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
        self.rows = torch.zeros(copies, sum(sizes), dtype=torch.float64)
        self._before = self.rows.clone()
        self.qpos, self.qvel, self.control = self.rows.split(sizes, dim=1)
        past_qpos, past_qvel, _ = self._before.split(sizes, dim=1)
        self._past = State(past_qpos, past_qvel)
        self.derived = {}

    def advance(self) -> State:
        """Apply the transition; see `Physics.advance`."""
        self._before.copy_(self.rows)
        qpos, qvel = self._transition(self._past.qpos, self._past.qvel, self.control)
        self.qpos.copy_(qpos)
        self.qvel.copy_(qvel)
        return self._past

    def place(self, rows: NDArray[np.intp], qpos: Float[Tensor, "R nq"], qvel: Float[Tensor, "R nv"]) -> None:
        """Write the states; see `Physics.place`."""
        index = torch.from_numpy(rows)
        self.qpos[index] = qpos
        self.qvel[index] = qvel

    def diverged(self) -> Divergence | None:
        """Where a number is not finite or beyond `LARGEST`; see `Physics.diverged`."""
        if self.rows.abs().max() <= LARGEST:  # NaN fails the test
            return None
        return Divergence(~(self.rows.abs().amax(dim=1) <= LARGEST), TOO_LARGE)

    def restore(self, rows: Bool[Tensor, " B"]) -> None:
        """Put back the state before the last step; see `Physics.restore`."""
        self.rows[rows] = self._before[rows]
