"""What collecting by several processes costs and saves: frames per second, and the price of a new policy.

    python -m benchmarks.collecting [--workers 2] [--out benchmarks/results/collecting.json]

Frames: the same environments stepped in this process and shared out to synchronous workers, in turns.
The price: before each rollout the learner writes policy and critic where workers read them, once each.
"""

import contextlib
import functools
import json
import os
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from torch import nn
from torchrl.envs import EnvBase

import envs
from benchmarks.timing import Turn, machine, rates
from torch_gprl.learners import QLearning, QLearningConfig, WorkerCollection
from torch_gprl.learners.board import Board, FollowingPolicy, content_of
from torch_gprl.learners.collecting import Collection
from torch_gprl.learners.workers import copied_for_workers

LEARNERS = 4
TICKS = os.sysconf("SC_CLK_TCK")  # of processor time in a second


@dataclass(frozen=True)
class Options:
    """What to measure."""

    workers: int = 2  # processes that share the environments
    tasks: tuple[str, ...] = ("pendulum-swingup", "HalfCheetah-v5")  # a cheap simulation and a dear one
    num_envs: int = 16  # environments of each of the four learners
    steps: int = 100  # of each environment in a rollout
    rounds: int = 5  # turns of each way to collect
    seconds: float = 3.0  # of each turn, at least
    budgets: tuple[int, ...] = (50, 200, 800)  # basis vectors of the critic
    out: Path | None = None  # JSON file


def make(task: str, num_envs: int, seed: int) -> EnvBase:
    """Environments of all learners."""
    return envs.make(task, learners=LEARNERS, num_envs=num_envs, seed=seed, threads=1)


def processor_seconds() -> float:
    """What this process and its children have used so far; workers live as long as this is asked."""
    folder = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    files = [Path(f"/proc/{child}/stat") for child in folder.read_text().split()]
    stats = [file.read_text().rpartition(")")[2] for file in files]  # what follows the program's name
    ticks = sum(int(field) for stat in stats for field in stat.split()[11:13])  # in user and system mode
    return time.process_time() + ticks / TICKS


def collecting(options: Options, task: str) -> dict[str, dict[str, float]]:
    """Frames per second by the clock, and per second of all processors, of both ways to collect."""
    env = make(task, options.num_envs, 0)
    policy = QLearning(env, QLearningConfig()).policy  # uniform actions: next to nothing but the simulation
    share = options.num_envs // options.workers
    factories = [functools.partial(make, task, share, 1 + worker) for worker in range(options.workers)]
    here = Collection(env, policy, options.steps)
    with contextlib.closing(WorkerCollection(factories, policy, options.steps)) as workers:
        ways = {"one process": here, f"{options.workers} workers": workers}
        turns: dict[str, Turn] = {name: functools.partial(frames_of, way) for name, way in ways.items()}
        for turn in turns.values():
            turn()  # the first starts the processes
        clocks = {"by the clock": time.perf_counter, "by processors": processor_seconds}
        found = {name: rates(turns, options.rounds, options.seconds, clock) for name, clock in clocks.items()}
    return found


def frames_of(way: Collection | WorkerCollection) -> int:
    """Collect a rollout, and count its frames."""
    return way.rollout().numel()


def price(budget: int, repeats: int = 30) -> dict[str, float]:
    """Bytes of a policy with a full critic for each learner, ms to write them and to act by them."""
    env = make("pendulum-swingup", 1, 0)
    learner = QLearning(env, QLearningConfig(budget=budget))
    inputs = torch.rand(LEARNERS, 4 * budget, 4, dtype=torch.float64) * 6
    learner.critic.gp.update(inputs, inputs.sum(-1).sin())
    modules = nn.ModuleDict({"policy": learner.policy, "critic": learner.critic})
    seen = env.reset()
    with tempfile.TemporaryDirectory() as name:
        board, (copied,) = Board(Path(name) / "board"), copied_for_workers(modules, 1)
        board.post(modules)
        worker, used = FollowingPolicy(copied, board.folder), {"write": 0.0, "read": 0.0}
        for _ in range(repeats):
            begin = time.process_time()
            board.post(modules)
            posted = time.process_time()
            worker(seen.clone())
            used["write"] += posted - begin
            used["read"] += time.process_time() - posted
    size = sum(tensor.nbytes for tensor in content_of(modules).values())
    milliseconds = {f"{name}_ms": 1000 * seconds / repeats for name, seconds in used.items()}
    return {"budget": budget, "basis": float(learner.critic.gp.size.max()), "bytes": size} | milliseconds


def main(options: Options) -> None:
    """Measure, print, and keep."""
    frames = {task: collecting(options, task) for task in options.tasks}
    for task, found in frames.items():
        for clock, speeds in found.items():
            told = ", ".join(f"{name} {speed:,.0f}" for name, speed in speeds.items())
            print(f"{task}: frames per second {clock}: {told}")
    prices = [price(budget) for budget in options.budgets]
    for new in prices:
        print(
            f"{new['basis']:.0f} basis vectors, {LEARNERS} learners: {new['bytes']:,} bytes, written in "
            f"{new['write_ms']:.1f} ms of a processor, taken up and acted by once in {new['read_ms']:.1f} ms"
        )
    if options.out:
        numbers = asdict(options) | {"out": None, "learners": LEARNERS}
        kept = machine() | {"options": numbers, "frames_per_second": frames, "prices": prices}
        options.out.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Options))
