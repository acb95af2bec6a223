"""Trajectories to compare with: SciPy's DOP853 on a task's equations of motion."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.integrate import solve_ivp
from tensordict import TensorDictBase

import envs


def simulated(task: str, start: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """States [T + 1, nq + nv] of an environment without noise from `start` under actions [T, da]."""
    env = envs.make(task, velocity_noise=0.0, dtype=torch.float64)
    qpos, qvel = torch.from_numpy(start).split([env.qpos.shape[-1], env.qvel.shape[-1]])
    data = env.place(qpos[None, None], qvel[None, None])
    states = [start]
    for action in actions:
        data["action"] = torch.as_tensor(action).reshape(env.action_spec.shape)
        data = env.step(data)["next"]
        states.append(torch.cat([env.qpos, env.qvel], -1).flatten().numpy())
    return np.stack(states)


def integrated(
    rates: Callable[[np.ndarray, np.ndarray], np.ndarray], start: np.ndarray, actions: np.ndarray, step: float
) -> np.ndarray:
    """States [T + 1, n] of ẋ = rates(x, u) with each action held for `step` seconds."""
    states = [start]
    for action in actions:
        solution = solve_ivp(
            lambda _, x, u=action: rates(x, u), (0, step), states[-1], "DOP853", rtol=1e-10, atol=1e-10
        )
        states.append(solution.y[:, -1])
    return np.stack(states)


def after_a_step(task: str, start: list[float], action: float) -> tuple[envs.BatchEnv, TensorDictBase]:
    """The environment and its output, in float64 and without noise, one step after (qpos, qvel) = `start`."""
    env = envs.make(task, velocity_noise=0.0, dtype=torch.float64, info=True)
    qpos, qvel = torch.tensor(start, dtype=torch.float64).split([env.qpos.shape[-1], env.qvel.shape[-1]])
    data = env.place(qpos[None, None], qvel[None, None])
    data["action"] = torch.full(env.action_spec.shape, action, dtype=torch.float64)
    return env, env.step(data)["next"]
