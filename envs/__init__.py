"""Environments: control tasks on batched MuJoCo simulations, for TorchRL and for Gymnasium."""

from envs import opengl  # noqa: F401  before all that import mujoco
from envs.batch import BatchEnv
from envs.copies import Options
from envs.gymnasium_env import register
from envs.registry import ALL, make
from envs.task import Noise, Plane, Task

register()

__all__ = ["ALL", "BatchEnv", "Noise", "Options", "Plane", "Task", "make"]
