"""The environments for Gymnasium, single and vectorised, registered as `torch_gprl/<task id>`.

Two conventions differ from the TorchRL side, as Gymnasium's checker recommends them: actions are shares of
the actuators' bounds, in [−1, 1], and observations are bounded by the largest float.
"""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from envs.copies import LONGEST_HORIZON, Copies, Options, Step
from envs.registry import ALL, find
from envs.rendering import Pictures
from envs.task import Noise, Task

DRAWS = {"render_modes": ["rgb_array"]}
NAMESPACE = "torch_gprl"
SEEDS = 2**31  # how many an environment chooses from when it is not given one

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


def spaces(task: Task, copies: Copies) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The observation and action space of one environment."""
    size = task.observation(copies.state).shape[1]
    largest = np.finfo(np.float32).max
    return (
        gymnasium.spaces.Box(-largest, largest, (size,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (len(task.action_low),), np.float32),
    )


def apply(copies: Copies, actions: NDArray[Any]) -> Step:
    """Step all copies with actions [B, da] in shares of the actuators' bounds.

    Raises:
        ValueError: if the shape is wrong or an entry is not finite.
    """
    expected = (copies.size, copies.low.size)
    if actions.shape != expected or not np.isfinite(actions).all():
        raise ValueError(f"actions must be finite and of shape {expected}, not {actions.shape}: {actions}")
    shares = np.asarray(actions, dtype=np.float64)
    return copies.step((copies.high + copies.low) / 2 + shares * (copies.high - copies.low) / 2)


def metadata(task: Task) -> dict[str, Any]:
    """What an environment can draw, and at which rate."""
    return {**DRAWS, "render_fps": max(1, round(1 / task.control_step))}


class SingleEnv(gymnasium.Env[Floats, Floats]):
    """One environment of a task; Gymnasium's `TimeLimit` wrapper sets its horizon.

    Args:
        task_id: the task.
        render_mode: "rgb_array" or None.
        noise: standard deviations in place of the task's own.
    """

    metadata = DRAWS  # Gymnasium asks the class

    def __init__(self, task_id: str, render_mode: str | None = None, noise: Noise | None = None) -> None:
        task = _task(task_id, noise)
        self._copies = Copies(task, Options(horizon=LONGEST_HORIZON, threads=1))
        self._pictures = Pictures(task)
        observation, action = spaces(task, self._copies)
        self.observation_space = observation  # pyright: ignore[reportAttributeAccessIssue]
        self.action_space = action  # pyright: ignore[reportAttributeAccessIssue]
        self.metadata = metadata(task)
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`. There are no options."""
        fresh = self._np_random is None
        super().reset(seed=seed)
        if seed is not None or fresh:
            self._copies.seed(int(self.np_random.integers(SEEDS)) if seed is None else seed)
        self._copies.reset(self._copies.all)
        return self._copies.observation()[0].astype(np.float32), {}

    def step(self, action: NDArray[Any]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One control step; `info` holds the parts of the reward."""
        observation, reward, parts, terminated, _ = apply(self._copies, np.asarray(action)[None])
        info = {f"reward_{name}": part.item() for name, part in parts.items()}
        return observation[0].astype(np.float32), reward.item(), bool(terminated.item()), False, info

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A frame [480, 480, 3], if the render mode asks for one."""
        if self.render_mode is None:
            return None
        return self._pictures.frame(self._copies.state.qpos[0])


class VectorEnv(gymnasium.vector.VectorEnv[Floats, Floats, NDArray[Any]]):
    """Environments of a task in one batch; an environment that is done is reset in the step after.

    Args:
        task_id: the task.
        num_envs: how many.
        max_episode_steps: control steps until truncation; None: the task's.
        threads: simulator threads; None: as many as the number of environments is worth.
        noise: standard deviations in place of the task's own.
    """

    def __init__(
        self,
        task_id: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        threads: int | None = None,
        noise: Noise | None = None,
    ) -> None:
        task = _task(task_id, noise)
        self._copies = Copies(task, Options(num_envs=num_envs, horizon=max_episode_steps, threads=threads))
        self.num_envs = num_envs
        observation, action = spaces(task, self._copies)
        self.single_observation_space, self.single_action_space = observation, action
        self.observation_space = batch_space(observation, num_envs)
        self.action_space = batch_space(action, num_envs)
        self.metadata = metadata(task) | {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self._done = np.zeros(num_envs, dtype=bool)

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start episodes in all environments, or in those of `options["reset_mask"]`.

        Args:
            seed: environment i draws from stream i of this seed.
            options: may hold `reset_mask`, booleans [num_envs].

        Raises:
            ValueError: if the seed is a list; streams of one seed differ already.
        """
        if isinstance(seed, list):
            raise ValueError(f"seed must be one number, not {seed}: environment i uses its stream i")
        fresh = self._np_random is None
        super().reset(seed=seed)
        if seed is not None or fresh:
            self._copies.seed(int(self.np_random.integers(SEEDS)) if seed is None else seed)
        rows = self._copies.all
        if options is not None and "reset_mask" in options:
            rows = np.flatnonzero(options["reset_mask"])
        self._copies.reset(rows)
        self._done[rows] = False
        return self._copies.observation().astype(np.float32), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """One control step of all; `infos` holds the parts of the rewards, [num_envs]."""
        observation, reward, parts, terminated, truncated = apply(self._copies, np.asarray(actions))
        infos = {f"reward_{name}": part.astype(np.float64) for name, part in parts.items()}
        results = reward.astype(np.float64), terminated, truncated
        if self._done.any():
            self._copies.reset(np.flatnonzero(self._done))
            observation = self._copies.observation()
            for values in (*results, *infos.values()):
                values[self._done] = 0
        self._done = results[1] | results[2]
        return observation.astype(np.float32), *results, infos


def _task(task_id: str, noise: Noise | None) -> Task:
    task = find(task_id)
    return task if noise is None else replace(task, noise=noise)


def register() -> None:
    """Tell Gymnasium of all tasks."""
    for task in ALL.values():
        gymnasium.register(
            id=f"{NAMESPACE}/{task.id}",
            entry_point=f"{__name__}:SingleEnv",
            vector_entry_point=f"{__name__}:VectorEnv",
            max_episode_steps=task.horizon,
            kwargs={"task_id": task.id},
        )
