"""How much experience does a task take? Our learners beside Stable-Baselines3's PPO and SAC.

    python -m benchmarks.sample_efficiency                        all tasks, all arms, 10 seeds
    python -m benchmarks.sample_efficiency --tasks Pendulum-v1 --arms q-learning --seeds 3
    python -m benchmarks.sample_efficiency --report               table and pictures of what is there

Every evaluation plays the deterministic policy from the same 100 starts (for Gymnasium's tasks those of its
seeds 1000 to 1099). A threshold counts as crossed at the first of three evaluations in a row above it; a
relapse is a later evaluation below it. Ours train their seeds side by side; CPU seconds are per seed.

Each finished (task, arm, seeds) is a record in --out, and a rerun skips what is there. Needs the extra
`bench` for the peers.
"""

import json
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from tensordict import TensorDict, TensorDictBase

import envs
from benchmarks import sample_report
from benchmarks.sample_arms import ARMS, GOALS, MAIN, Arm, Goal
from benchmarks.timing import machine
from torch_gprl.runs import evaluate

START_SEED = 1000


@dataclass(frozen=True)
class Options:
    """What to compare."""

    tasks: tuple[str, ...] = tuple(GOALS)
    arms: tuple[str, ...] = MAIN  # and those that take a part of Q-learning away
    seeds: int = 10  # of each arm
    first_seed: int = 0
    episodes: int = 100  # of an evaluation
    quick: bool = False  # a tenth of the experience, 10 episodes: to see that everything runs
    report: bool = False  # run nothing, show the records
    out: Path = Path("benchmarks/results/sample_efficiency")  # records, summary.json, and the pictures


class FixedStarts(envs.BatchEnv):
    """An environment whose first episodes begin in the same states for every learner, at every reset.

    Args:
        task: id of the task.
        learners: policies evaluated together.
        episodes: starts, those of seeds 1000, 1001, ...
    """

    def __init__(self, task: str, learners: int, episodes: int) -> None:
        one = envs.make(task, num_envs=episodes, seed=START_SEED, threads=1)
        one.reset()
        self.starts = one.qpos.expand(learners, -1, -1), one.qvel.expand(learners, -1, -1)
        options = envs.Options(learners=learners, num_envs=episodes, seed=START_SEED, threads=1)
        super().__init__(envs.ALL[task], options)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118  (a tensordict)
            return super()._reset(tensordict, **kwargs)
        self._set_seed(START_SEED)
        return self.place(*self.starts)


def run(task: str, arm: Arm, seeds: range, goal: Goal, options: Options) -> dict[str, Any]:
    """Train these seeds and evaluate them on the way."""
    frames, every = arm.budget(goal)
    if options.quick:
        frames = max(every, frames // 10)
    starts = FixedStarts(task, len(seeds), 10 if options.quick else options.episodes)
    record: dict[str, Any] = {"frames": [], "cpu_seconds": [], "returns": []}
    spent, since = 0.0, time.process_time()
    for seen, policy in arm.train(task, seeds, frames, every):
        spent += time.process_time() - since
        record["frames"].append(seen)
        record["cpu_seconds"].append(spent / len(seeds))
        record["returns"].append(evaluate(starts, policy).mean(-1).tolist())
        since = time.process_time()
    return record


def groups(options: Options) -> list[tuple[str, str, range]]:
    """(task, arm, seeds) of every record."""
    last = options.first_seed + options.seeds
    return [
        (task, arm, range(first, min(first + ARMS[arm].side_by_side, last)))
        for task in options.tasks
        for arm in options.arms
        for first in range(options.first_seed, last, ARMS[arm].side_by_side)
    ]


def measure(options: Options, console: Console) -> None:
    """Make the records that are missing."""
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=len(groups(options)))
        for task, name, seeds in groups(options):
            progress.update(bar, description=f"{task}, {name}, seeds {seeds.start} to {seeds[-1]}")
            path = (
                options.out / "records" / f"{task}--{name.replace(' ', '-')}--{seeds.start}-{seeds[-1]}.json"
            )
            if not path.exists():
                record = run(task, ARMS[name], seeds, GOALS[task], options)
                record = {"task": task, "arm": name, "seeds": list(seeds), "machine": machine(), **record}
                path.parent.mkdir(parents=True, exist_ok=True)
                partial = path.with_suffix(".partial")
                partial.write_text(json.dumps(record) + "\n", encoding="utf-8")
                partial.rename(path)
            progress.advance(bar)


def check(**names: tuple[Iterable[str], Collection[str]]) -> None:
    """Refuse names that do not exist.

    Args:
        names: by their kind, those that were chosen and those that there are.

    Raises:
        ValueError: naming what there is.
    """
    for kind, (chosen, known) in names.items():
        for name in chosen:
            if name not in known:
                raise ValueError(f"unknown {kind} {name!r}; choose from {', '.join(known)}")


def main(options: Options) -> None:
    """Measure what is missing, print, write."""
    check(task=(options.tasks, GOALS), arm=(options.arms, ARMS))
    torch.set_num_threads(1)
    if not options.report:
        measure(options, Console(stderr=True))
    records = sample_report.read(options.out / "records")
    rows = sample_report.summarise(records, GOALS)
    sample_report.print_table(rows, Console())
    for path in sample_report.write(rows, records, GOALS, options.out):
        print(f"wrote {path}")


if __name__ == "__main__":
    main(tyro.cli(Options))
