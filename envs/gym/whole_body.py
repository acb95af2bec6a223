"""Gymnasium's three-dimensional bodies, which feel their contact forces: Ant and Humanoid."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from envs.gym.base import GymnasiumTask, asset, shared, squares
from envs.physics import MujocoPhysics, State
from envs.task import Reward

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

FORCES = "cfrc_ext"  # external forces on the bodies, [nbody, 6]
LARGEST_TORQUE = float(np.float32(0.4))  # of the humanoid, by Gymnasium's action space


def flat(values: Float[np.ndarray, "B ..."]) -> Float[np.ndarray, "B n"]:
    """One row for each copy."""
    return values.reshape(len(values), -1)


class ContactPhysics(MujocoPhysics):
    """Copies whose external forces are computed after each control step, as Gymnasium does.

    Neither `mj_step` nor a sensor gives these numbers: under Runge-Kutta's rule Gymnasium evaluates
    `mj_rnePostConstraint` on a mixture of the last stage's contacts and the new velocities. So each copy
    keeps its MjData, and the function is called on one after the other.
    """

    def __init__(
        self, model: mujoco.MjModel, copies: int, substeps: int, threads: int, derived: tuple[str, ...]
    ) -> None:
        super().__init__(model, copies, substeps, threads, derived, persistent=True)
        self._data = mujoco.MjData(model)
        self._forces = np.zeros((copies, model.nbody, 6))
        self.derived[FORCES] = self._forces
        self._past_derived[FORCES] = self._forces.copy()

    def advance(self) -> State:
        """Advance every copy, then compute the external forces; see `Physics.advance`."""
        past = super().advance()
        for copy, forces in enumerate(self._forces):
            data = self.batch.get_data(copy, self._data)
            mujoco.mj_rnePostConstraint(self.model, data)
            forces[:] = data.cfrc_ext
        return past

    def place(
        self, rows: NDArray[np.intp], qpos: Float[np.ndarray, "R nq"], qvel: Float[np.ndarray, "R nv"]
    ) -> None:
        """Reset copies; Gymnasium shows no forces until the first step. See `Physics.place`."""
        super().place(rows, qpos, qvel)
        self._forces[rows] = 0


@dataclass(frozen=True, kw_only=True)
class Body(GymnasiumTask):
    """What Ant and Humanoid share."""

    heights: tuple[float, float]  # m, of the torso, when healthy

    def physics(self, copies: int, threads: int) -> ContactPhysics:
        """Gymnasium's model with contact forces."""
        return ContactPhysics(shared(self.scene), copies, self.frame_skip, threads, self.derived)


@dataclass(frozen=True, kw_only=True)
class Ant(Body):
    """Run along x on four legs."""

    CONTROL_WEIGHT = 0.5
    CONTACT_WEIGHT = 5e-4
    LARGEST_FORCE = 1.0  # forces are clipped to it

    def observation(self, state: State) -> Float[np.ndarray, "B 105"]:
        """Positions without x and y, velocities, and the bodies' clipped external forces."""
        forces = state.derived[FORCES][:, 1:].clip(-self.LARGEST_FORCE, self.LARGEST_FORCE)
        return np.concatenate([state.qpos[:, 2:], state.qvel, flat(forces)], axis=-1)

    def reward(self, before: State, action: Float[np.ndarray, "B 8"], after: State) -> Reward:
        """`forward` speed of the torso and `survive`, less `ctrl` and `contact`."""
        moved = after.derived["xpos"][:, 1, 0] - before.derived["xpos"][:, 1, 0]
        forward = moved / self.control_step
        survive = (~self.terminated(after)).astype(np.float64)
        control = squares(action) * self.CONTROL_WEIGHT
        forces = after.derived[FORCES].clip(-self.LARGEST_FORCE, self.LARGEST_FORCE)
        contact = flat(np.square(forces)).sum(axis=-1) * self.CONTACT_WEIGHT
        return Reward(
            forward + survive - (control + contact),
            {"forward": forward, "survive": survive, "ctrl": -control, "contact": -contact},
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """Torso outside its healthy heights."""
        height = state.qpos[:, 2]
        return ~((self.heights[0] <= height) & (height <= self.heights[1]))


@dataclass(frozen=True, kw_only=True)
class Humanoid(Body):
    """Walk along x on two legs."""

    FORWARD_WEIGHT = 1.25
    CONTROL_WEIGHT = 0.1
    CONTACT_WEIGHT = 5e-7
    LARGEST_CONTACT_COST = 10.0
    SURVIVE = 5.0

    def observation(self, state: State) -> Float[np.ndarray, "B 348"]:
        """Positions without x and y, velocities, and per body: inertia, velocity, actuation, forces."""
        derived = state.derived
        return np.concatenate(
            [
                state.qpos[:, 2:],
                state.qvel,
                flat(derived["cinert"][:, 1:]),
                flat(derived["cvel"][:, 1:]),
                derived["qfrc_actuator"][:, 6:],
                flat(derived[FORCES][:, 1:]),
            ],
            axis=-1,
        )

    def reward(self, before: State, action: Float[np.ndarray, "B 17"], after: State) -> Reward:
        """`forward` speed of the centre of mass and `survive`, less `ctrl` and `contact`."""
        forward = (self._centre(after) - self._centre(before)) / self.control_step * self.FORWARD_WEIGHT
        survive = (~self.terminated(after)).astype(np.float64) * self.SURVIVE
        control = np.square(action).sum(axis=-1) * self.CONTROL_WEIGHT
        contact = flat(np.square(after.derived[FORCES])).sum(axis=-1) * self.CONTACT_WEIGHT
        contact = np.minimum(contact, self.LARGEST_CONTACT_COST)
        return Reward(
            forward + survive - (control + contact),
            {"forward": forward, "survive": survive, "ctrl": -control, "contact": -contact},
        )

    def terminated(self, state: State) -> Bool[np.ndarray, " B"]:
        """Torso outside its healthy heights."""
        height = state.qpos[:, 2]
        return ~((self.heights[0] < height) & (height < self.heights[1]))

    def _centre(self, state: State) -> Float[np.ndarray, " B"]:
        """Where along x the centre of mass was at the last physics step, added in NumPy's order."""
        mass = shared(self.scene).body_mass
        return (np.einsum("b,nbj->nj", mass, state.derived["xipos"]) / mass.sum())[:, 0]


TASKS = (
    Ant(
        id="Ant-v5",
        horizon=1000,
        scene=asset("ant.xml"),
        control_step=0.01 * 5,
        frame_skip=5,
        start_noise=0.1,
        normal_velocities=True,
        derived=("xpos",),
        heights=(0.2, 1.0),
        action_low=(-1.0,) * 8,
        action_high=(1.0,) * 8,
    ),
    Humanoid(
        id="Humanoid-v5",
        horizon=1000,
        scene=asset("humanoid.xml"),
        control_step=0.003 * 5,
        frame_skip=5,
        start_noise=1e-2,
        derived=("xipos", "cinert", "cvel", "qfrc_actuator"),
        heights=(1.0, 2.0),
        action_low=(-LARGEST_TORQUE,) * 17,
        action_high=(LARGEST_TORQUE,) * 17,
    ),
)
