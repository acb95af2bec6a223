"""Copies of a task, stepped together: the part that TorchRL's and Gymnasium's interfaces share.

Everything here is flat: B copies over the simulator's one NumPy array, float64.
"""

import math
import os
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from envs.noise import StepNoise
from envs.physics import Divergence, State
from envs.streams import StartDraws, Streams
from envs.task import Task

NOISE_BLOCKS = {
    "action": 1 << 14,
    "velocity": 2 << 14,
    "observation": 3 << 14,
}  # room for 32,768 numbers each
DTYPES = (torch.float64, torch.float32, torch.float16)  # those that NumPy has too
LONGEST_HORIZON = 2**32 - 1  # steps that the random numbers' addresses have room for
COPIES_PER_THREAD = 64  # fewer copies than this are not worth waking another thread for


@dataclass(frozen=True)
class Options:
    """How many copies of a task run, where, and with which changes to the task's defaults."""

    learners: int = 1  # independent learners, the leading batch dimension
    num_envs: int = 1  # environments of each learner
    seed: int = 0
    device: str | torch.device = "cpu"  # where outputs go; the simulation itself runs on the CPU
    threads: int | None = None  # simulator threads; None: as many as the number of copies is worth
    dtype: torch.dtype = torch.float32  # of observations, actions and rewards
    horizon: int | None = None  # control steps until truncation; None: the task's
    observation_noise: float | None = None  # standard deviations, see `Noise`; None: the task's
    action_noise: float | None = None
    velocity_noise: float | None = None
    info: bool = False  # write the named parts of the reward under "info"
    first_learner: int = 0  # index of the first learner: learner i of a batch, alone, is first_learner=i

    def __post_init__(self) -> None:
        for name, least in (
            ("learners", 1),
            ("num_envs", 1),
            ("first_learner", 0),
            ("horizon", 1),
            ("threads", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, not {value}")
        if self.horizon is not None and self.horizon > LONGEST_HORIZON:
            raise ValueError(f"horizon must be at most {LONGEST_HORIZON}, not {self.horizon}")
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {', '.join(map(str, DTYPES))}, not {self.dtype}")
        for name in ("observation_noise", "action_noise", "velocity_noise"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"{name} is a standard deviation, at least 0 and finite, not {value}")


class Step(NamedTuple):
    """The outcome of a step, all [B] or [B, do]."""

    observation: NDArray[np.float64]
    reward: NDArray[np.floating]
    parts: dict[str, NDArray[np.floating]]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Copies:
    """B = learners · num_envs copies of a task.

    Args:
        task: the task.
        options: how many, and with which noise.

    Attributes:
        state: live views of the positions and velocities.
        steps: [B] control steps since each episode's start.
        divergences: how many simulations have diverged so far.
    """

    def __init__(self, task: Task, options: Options) -> None:
        self.task, self.options = task, options
        self.size = options.learners * options.num_envs
        self.all = np.arange(self.size)
        self.low, self.high = np.array(task.action_low), np.array(task.action_high)
        self.steps = np.zeros(self.size, dtype=np.int64)
        self.divergences = 0
        self._horizon = task.horizon if options.horizon is None else options.horizon
        self._physics = task.physics(self.size, _threads(options.threads, self.size))
        self.state = State(self._physics.qpos, self._physics.qvel, self._physics.derived)
        self.seed(options.seed)

    def seed(self, seed: int) -> None:
        """Start all random streams anew; takes effect at the next reset."""
        options = self.options
        self._streams = Streams(seed, options.learners, options.num_envs, options.first_learner)
        widths = {
            "action": self.low.size,
            "velocity": self.state.qvel.shape[1],
            "observation": self.task.observation(self.state).shape[1],
        }
        self._noise: dict[str, StepNoise] = {}
        for name, block in NOISE_BLOCKS.items():
            chosen = getattr(options, f"{name}_noise")
            std = getattr(self.task.noise, name) if chosen is None else chosen
            if std > 0:
                self._noise[name] = StepNoise(self._streams, std, widths[name], block)

    def reset(self, rows: NDArray[np.intp]) -> None:
        """Start new episodes in the copies `rows` [R], which may be none."""
        if not rows.size:
            return
        self._streams.episode[rows] += np.uint64(1)
        self.steps[rows] = 0
        self._physics.place(rows, *self.task.start(StartDraws(self._streams, rows)))
        for noise in self._noise.values():
            noise.start(rows)

    def place(self, qpos: Float[np.ndarray, "B nq"], qvel: Float[np.ndarray, "B nv"]) -> None:
        """Start new episodes of all copies in the given states."""
        self.reset(self.all)
        self._physics.place(self.all, qpos, qvel)

    def save(self) -> dict[str, Tensor]:
        """All that the future depends on, as copies."""
        live = {"physics": self._physics.rows, "steps": self.steps}
        live |= {f"derived {name}": value for name, value in self.state.derived.items()}
        return {name: torch.from_numpy(value.copy()) for name, value in live.items()} | self._streams.save()

    def load(self, saved: dict[str, Tensor]) -> None:
        """Go on from what `save` gave, bit for bit.

        Raises:
            ValueError: if it was saved from other numbers of copies or from another system.
        """
        if saved["physics"].shape != self._physics.rows.shape:
            raise ValueError(
                f"the saved environment has {list(saved['physics'].shape)} numbers (copies, state), this one "
                f"{list(self._physics.rows.shape)}; make it with the same task, learners and num_envs"
            )
        self._physics.rows[:] = saved["physics"].numpy()
        for name, value in self.state.derived.items():
            value[:] = saved[f"derived {name}"].numpy()
        self.steps[:] = saved["steps"].numpy()
        self._streams.load(saved)
        for noise in self._noise.values():
            noise.resume(self.steps)

    def observation(self) -> Float[np.ndarray, "B do"]:
        """What the agent sees of the present state."""
        observation = self.task.observation(self.state)
        if "observation" in self._noise:
            observation += self._noise["observation"].now
        return observation

    def step(self, action: Float[np.ndarray, "B da"]) -> Step:
        """Advance every copy by one control step.

        Args:
            action: [B, da] finite commands in the actuators' units; noise is added, then they are clipped.
        """
        self.steps += 1
        for noise in self._noise.values():
            noise.advance(self.steps)
        if "action" in self._noise:
            action = action + self._noise["action"].now
        applied = action.clip(self.low, self.high, out=self._physics.control)
        before = self._physics.advance()
        if "velocity" in self._noise:
            np.add(self.state.qvel, self._noise["velocity"].now, out=self.state.qvel)
        divergence = self._physics.diverged()
        if divergence is not None:
            self._undo(divergence)
        reward, parts = self.task.reward(before, applied, self.state)
        terminated = self.task.terminated(self.state)
        if divergence is not None:
            terminated = terminated | divergence.copies
        return Step(self.observation(), reward, parts, terminated, self.steps >= self._horizon)

    def _undo(self, divergence: Divergence) -> None:
        """Put lost simulations back into their last good state, count them, and warn of the first."""
        if not self.divergences:
            learner, env = divmod(int(divergence.copies.argmax()), self.options.num_envs)
            warnings.warn(
                f"{self.task.id}: the simulation of learner {learner}, environment {env} diverged with "
                f"{divergence.reason}; such episodes end as terminated and are counted in `divergences`. "
                f"Smaller actions or less noise may help",
                RuntimeWarning,
                stacklevel=4,
            )
        self.divergences += int(divergence.copies.sum())
        self._physics.restore(divergence.copies)


def _threads(threads: int | None, copies: int) -> int:
    if threads is not None:
        return threads
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, copies // COPIES_PER_THREAD))
