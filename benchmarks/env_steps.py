"""What a step of experience costs: our batch, and its peers, against MuJoCo's own step.

    python -m benchmarks.env_steps --tasks pendulum-swingup HalfCheetah-v5

The ceiling is `mj_step` in an open loop over the same model, the same starts and the same held actions. All
take turns, round after round; a competitor's figure is its best round, in CPU time of this process, or in
wall time where the work is done by other processes. Results go to a JSON file and a picture.
"""

import json
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torchrl.envs import EnvBase, GymEnv, ParallelEnv

import envs
from benchmarks.timing import machine
from envs.physics import MujocoPhysics

Steps = Callable[[], int]
"""Takes some environment steps and returns how many."""

Clock = Callable[[], float]
"""Seconds, monotonic."""

CEILING = "mj_step, open loop"


@dataclass(frozen=True)
class Config:
    """What to measure."""

    tasks: tuple[str, ...] = ("pendulum-swingup", "HalfCheetah-v5")
    sizes: tuple[int, ...] = (64, 256, 1024)  # environments in a batch
    rounds: int = 15  # turns of each competitor
    steps: int = 12800  # environment steps in a turn
    processes: int = 2  # of competitors that use several; 0 leaves them out
    out: Path = Path("runs/env_steps.json")  # the picture lies beside it


@dataclass(frozen=True)
class Competitor:
    """A way to step a task."""

    name: str
    num_envs: int
    steps: Steps
    restart: Callable[[], object]
    clock: Clock = time.process_time
    close: Callable[[], object] = lambda: None


def held_actions(task: envs.Task, num_envs: int) -> np.ndarray:
    """One random action for each environment, [num_envs, da]; the first k are the same in any batch."""
    shares = np.random.default_rng(0).uniform(-1, 1, (num_envs, len(task.action_low)))
    low, high = np.array(task.action_low), np.array(task.action_high)
    return (low + (shares + 1) / 2 * (high - low)).astype(np.float32)


def open_loop(task: envs.Task, num_envs: int, steps: int) -> Competitor:
    """`mj_step` alone, from the starts of our batch, one copy after the other."""
    physics = task.physics(1, 1)
    assert isinstance(physics, MujocoPhysics)
    env = envs.make(task.id, num_envs=num_envs, seed=0)
    env.reset()
    starts = list(zip(env.qpos[0].numpy(), env.qvel[0].numpy(), held_actions(task, num_envs), strict=True))
    model, substeps, length = physics.model, physics.substeps, max(1, steps // num_envs)
    simulations = [mujoco.MjData(model) for _ in starts]

    def restart() -> None:
        for data, (qpos, qvel, action) in zip(simulations, starts, strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, action

    def turn() -> int:
        for data in simulations:
            for _ in range(length):
                mujoco.mj_step(model, data, substeps)
        return length * num_envs

    return Competitor(CEILING, num_envs, turn, restart)


def ours(task: envs.Task, num_envs: int, steps: int) -> Competitor:
    """Our batch as a TorchRL environment."""
    env = envs.make(task.id, num_envs=num_envs, seed=0, threads=1)
    return torchrl("ours, TorchRL", env, torch.from_numpy(held_actions(task, num_envs))[None], steps)


def ours_gymnasium(task: envs.Task, num_envs: int, steps: int) -> Competitor:
    """Our batch as a Gymnasium vector environment."""
    env = gymnasium.make_vec(f"torch_gprl/{task.id}", num_envs=num_envs, threads=1)
    shares = held_actions(task, num_envs) / np.array(task.action_high, dtype=np.float32)
    return vector("ours, Gymnasium vector", env, shares, steps)


def torchrl(
    name: str, env: EnvBase, actions: torch.Tensor, steps: int, clock: Clock = time.process_time
) -> Competitor:
    """A TorchRL environment under held actions."""
    length = max(1, steps // env.numel())
    data = env.reset()

    def restart() -> None:
        nonlocal data
        env.set_seed(0)
        data = env.reset()

    def turn() -> int:
        nonlocal data
        for _ in range(length):
            data.set("action", actions)
            _, data = env.step_and_maybe_reset(data)
        return length * env.numel()

    return Competitor(name, env.numel(), turn, restart, clock, env.close)


def vector(
    name: str, env: VectorEnv, actions: np.ndarray, steps: int, clock: Clock = time.process_time
) -> Competitor:
    """A Gymnasium vector environment under held actions."""
    length = max(1, steps // env.num_envs)

    def turn() -> int:
        for _ in range(length):
            env.step(actions)
        return length * env.num_envs

    return Competitor(name, env.num_envs, turn, lambda: env.reset(seed=0), clock, env.close)


def gymnasium_id(task: envs.Task) -> str:
    """Gymnasium's own environment where there is one, else ours through Gymnasium."""
    return task.id if task.id in gymnasium.registry else f"torch_gprl/{task.id}"


def _single(task: envs.Task, steps: int) -> Competitor:
    env = gymnasium.make(gymnasium_id(task))
    action = env.action_space.sample()

    def turn() -> int:
        for _ in range(steps // 4):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return steps // 4

    return Competitor("Gymnasium, single", 1, turn, lambda: env.reset(seed=0), close=env.close)


def peers(task: envs.Task, config: Config) -> list[Competitor]:
    """Other ways to step the task."""
    name, size, steps = gymnasium_id(task), config.sizes[0], config.steps
    found = [_single(task, steps)]
    sync = gymnasium.make_vec(name, num_envs=size, vectorization_mode="sync")
    found.append(vector("Gymnasium SyncVectorEnv", sync, sync.action_space.sample(), steps // 4))
    single = GymEnv(name)
    found.append(torchrl("TorchRL GymEnv", single, single.rand_action()["action"], steps // 4))
    if config.processes:
        wall = time.perf_counter
        workers = gymnasium.make_vec(name, num_envs=config.processes, vectorization_mode="async")
        action = workers.action_space.sample()
        found.append(vector("Gymnasium AsyncVectorEnv", workers, action, steps // 4, wall))
        pool = ParallelEnv(config.processes, lambda: GymEnv(name))
        action = pool.rand_action()["action"]
        found.append(torchrl("TorchRL ParallelEnv", pool, action, steps // 16, wall))
    if find_spec("envpool") and task.id.endswith("-v5"):
        import envpool  # pyright: ignore[reportMissingImports]

        known = task.id.replace("-v5", "-v4")
        fast = envpool.make_gymnasium(known, num_envs=size, num_threads=1)
        action = np.stack([fast.action_space.sample() for _ in range(size)])
        found.append(vector(f"envpool {known}", fast, action, steps))
    return found


def measure(task: envs.Task, config: Config) -> list[dict[str, Any]]:
    """Microseconds per environment step of every competitor, with the ratio to the ceiling at its size."""
    field = [make(task, n, config.steps) for n in config.sizes for make in (open_loop, ours, ours_gymnasium)]
    field += peers(task, config)
    best = [float("inf")] * len(field)
    for _ in range(config.rounds):
        for place, competitor in enumerate(field):
            competitor.restart()
            start = competitor.clock()
            steps = competitor.steps()
            best[place] = min(best[place], (competitor.clock() - start) / steps * 1e6)
    for competitor in field:
        competitor.close()
    ceilings = {c.num_envs: cost for c, cost in zip(field, best, strict=True) if c.name == CEILING}
    return [
        {
            "task": task.id,
            "name": competitor.name,
            "num_envs": competitor.num_envs,
            "clock": competitor.clock.__name__,
            "microseconds": cost,
            "ratio": cost / ceilings.get(competitor.num_envs, min(ceilings.values())),
        }
        for competitor, cost in zip(field, best, strict=True)
    ]


def report(rows: list[dict[str, Any]], console: Console) -> None:
    """A table of each task."""
    for task in dict.fromkeys(row["task"] for row in rows):
        table = Table("", "environments", "µs per step", "× ceiling", "clock", title=task)
        for row in rows:
            if row["task"] == task:
                cells = (f"{row['num_envs']}", f"{row['microseconds']:.1f}", f"{row['ratio']:.2f}")
                table.add_row(row["name"], *cells, row["clock"])
        console.print(table)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Bars of the ratios to the ceiling, one panel for each task."""
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure = Figure(figsize=(6.5 * len(tasks), 5), layout="constrained")
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        own = [row for row in rows if row["task"] == task][::-1]
        colours = ["tab:red" if row["name"].startswith("ours") else "tab:gray" for row in own]
        labels = [f"{row['name']}, {row['num_envs']}" for row in own]
        bars = axes.barh(labels, [row["ratio"] for row in own], color=colours)
        axes.bar_label(bars, [f"{row['ratio']:.2f}" for row in own], padding=3)
        axes.axvline(1, color="black", linewidth=0.8)
        axes.set_xscale("log")
        axes.set_xlabel("cost of an environment step, × mj_step")
        axes.set_title(task)
        axes.margins(x=0.15)
    FigureCanvasAgg(figure).print_png(path)


def main(config: Config) -> None:
    """Measure, print, write."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)  # of the peers
    rows = [row for task in config.tasks for row in measure(envs.ALL[task], config)]
    report(rows, Console())
    config.out.parent.mkdir(parents=True, exist_ok=True)
    result = {"machine": machine(), "rounds": config.rounds, "rows": rows}
    config.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    draw(rows, config.out.with_suffix(".png"))
    print(f"{config.out} and {config.out.with_suffix('.png')}")


if __name__ == "__main__":
    main(tyro.cli(Config))
