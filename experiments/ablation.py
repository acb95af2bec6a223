"""What each part of planning brings: dynamic programming with one part changed at a time.

    python -m experiments.ablation [--tasks Pendulum-v1] [--rows ...] [--learners 10] [--frames 600]
    python -m experiments.ablation --report           the table of what is there

Thresholds, fixed starts and sustained crossings as in `benchmarks.sample_efficiency`. All figures go to one
file, row by row; a rerun skips the rows that are there.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console

from benchmarks import sample_efficiency, sample_report
from benchmarks.sample_arms import GOALS, ours
from benchmarks.timing import machine

PLAN: dict[str, object] = {"rehearsal": 0, "look_ahead": 0}
ROWS: dict[str, dict[str, object]] = {
    "all parts": {},
    "no looking ahead": {"look_ahead": 0},
    "the plan alone": PLAN,
    "the plan, one step held": PLAN | {"hold": 1},
    "the plan, three steps held": PLAN | {"hold": 3},
    "the plan, nothing imagined": PLAN | {"imagined": 0},
    "the plan, no hope beyond the best seen": PLAN | {"optimism": 0.0},
    "the plan, a steady hand": PLAN | {"tremble": 0.01},
    "the plan, Matérn 3/2 value": PLAN | {"smoothness": 1.5},
    "the plan, Matérn 5/2 value": PLAN | {"smoothness": 2.5},
    "the plan, half the support": PLAN | {"support": 100},
    "the plan, looking ahead": {"rehearsal": 0},
}


@dataclass(frozen=True)
class Options:
    """What to change, and where to try it."""

    tasks: tuple[str, ...] = ("Pendulum-v1", "pendulum-explore", "InvertedPendulum-v5")
    rows: tuple[str, ...] = tuple(ROWS)
    learners: int = 10  # of each row
    frames: int = 600  # environment steps per learner
    every: int = 100  # environment steps between evaluations
    episodes: int = 10  # of an evaluation, for each learner
    report: bool = False  # run nothing, show the records
    out: Path = Path("experiments/results/ablation.json")


def run(task: str, row: str, options: Options) -> dict[str, Any]:
    """Train the learners of a row and evaluate them on the way."""
    goal = replace(GOALS[task], frames=options.frames, every=options.every)
    arm = ours("DynamicProgramming", **ROWS[row])
    seeds = range(options.learners)
    starts = sample_efficiency.Options(episodes=options.episodes)
    record = sample_efficiency.run(task, arm, seeds, goal, starts)
    return {"task": task, "arm": row, "seeds": list(seeds), "machine": machine(), **record}


def main(options: Options) -> None:
    """Run the rows that are missing, write after each, print all."""
    sample_efficiency.check(task=(options.tasks, GOALS), row=(options.rows, ROWS))
    torch.set_num_threads(1)
    out = options.out
    records = json.loads(out.read_text(encoding="utf-8"))["records"] if out.exists() else []
    there = {(record["task"], record["arm"]) for record in records}
    missing = [(task, row) for task in options.tasks for row in options.rows if (task, row) not in there]
    for task, row in [] if options.report else missing:
        records.append(run(task, row, options))
        result = {"rows": sample_report.summarise(records, GOALS), "records": records}
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, ensure_ascii=False) + "\n", encoding="utf-8")
    sample_report.print_table(sample_report.summarise(records, GOALS), Console())


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
