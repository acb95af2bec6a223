"""The list of tasks, and `make`, which turns one into an environment."""

import difflib

from envs import atwood, car_on_hill, cartpole, crane, gym, pendulum
from envs.batch import BatchEnv
from envs.copies import Options
from envs.task import Task

SYSTEMS = (pendulum, cartpole, atwood, crane, car_on_hill, gym)
ALL: dict[str, Task] = {task.id: task for system in SYSTEMS for task in system.TASKS}


def find(task_id: str) -> Task:
    """The task of that id.

    Raises:
        ValueError: if there is none; the message names the nearest and all.
    """
    if task_id in ALL:
        return ALL[task_id]
    near = difflib.get_close_matches(task_id, ALL, n=1, cutoff=0.3)
    hint = f"did you mean {near[0]!r}? Or choose" if near else "choose"
    raise ValueError(f"unknown task {task_id!r}; {hint} one of {', '.join(ALL)}")


def make(task_id: str, **options: object) -> BatchEnv:
    """A TorchRL environment of batch `[learners, num_envs]`.

    Args:
        task_id: a key of `ALL`, for example "pendulum-swingup".
        **options: the fields of `Options`: learners, num_envs, seed, device, threads, dtype, horizon,
            observation_noise, action_noise, velocity_noise, info, first_learner.

    Raises:
        ValueError: if the task is unknown or an option is out of its range.
    """
    return BatchEnv(find(task_id), Options(**options))  # pyright: ignore[reportArgumentType]
