"""Environments: control tasks on batched MuJoCo simulations, for TorchRL and for Gymnasium."""

from envs.batch import BatchEnv
from envs.copies import Options
from envs.registry import ALL, make
from envs.task import Noise, Plane, Task

__all__ = ["ALL", "BatchEnv", "Noise", "Options", "Plane", "Task", "make"]
