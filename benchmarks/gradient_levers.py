"""What each number gives: all-action policy gradients on Pendulum-v1 from batches of 200 steps.

    python -m benchmarks.gradient_levers                            every lever for 3,000 environment steps
    python -m benchmarks.gradient_levers --levers "as preset" --frames 13000 --learners 15 --episodes 100

The preset of `train.py` for this task, and the same with one number changed. After every batch, 40 steps of
five environments (later every fifth), the deterministic policy plays the same starts, those of Gymnasium's
seeds 1000, 1001, ... A learner has solved the task at the first of three evaluations in a row at -200 or
above; a relapse is a later evaluation below.

Every five learners leave a record in --out; a rerun skips what is there, and shows all in a table and a
picture.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure

import envs
from benchmarks.sample_efficiency import FixedStarts
from benchmarks.sample_report import NEVER, outcomes
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.runs import evaluate, save_figure
from train import POLICY_GRADIENT_PRESETS

TASK, THRESHOLD = "Pendulum-v1", -200.0
SIDE_BY_SIDE = 5  # learners of one record
COLOURS = 10  # of a picture's lines before they repeat
WATCHED = 3_000  # environment steps after each batch of which policies are played; later after every fifth
LEVERS: dict[str, dict[str, Any]] = {
    "as preset": {},
    "one episode per batch": {"num_envs": 1, "rollout_steps": 200},
    "one step of the policy per batch": {"improvements": 0},
    "undamped natural steps": {"damping": 1e-3},
    "learned exploration": {"exploration": "learned"},
    "discount 0.98": {"discount": 0.98},
    "the newest 1,000 steps alone": {"replay": 1_000},
    "the newest 4,000, noise 0.005": {"replay": 4_000, "solved": 4_000, "noise": 0.005},
    "noise of differences 0.02": {"noise": 0.02},
    "state length scales 0.3": {"lengthscale": 0.3},
    "unit action length scale": {"action_lengthscale": 1.0},
    "half the basis": {"budget": 75},
    "smaller trust region": {"trust_region": 0.01},
    "generalised advantages, no replay": {
        "estimator": "generalised",
        "improvements": 0,
        "replay": 0,
        "rollout_steps": 200,
        "num_envs": 1,
    },
}


@dataclass(frozen=True)
class Options:
    """What to compare."""

    levers: tuple[str, ...] = tuple(LEVERS)
    frames: int = 3_000  # environment steps per learner
    learners: int = 10  # of each lever
    episodes: int = 30  # of an evaluation
    out: Path = Path("benchmarks/results/gradient_levers")  # where records, table and picture go


def main(options: Options) -> None:
    """Run what has no record yet; print, write, draw."""
    torch.set_num_threads(1)
    (options.out / "records").mkdir(parents=True, exist_ok=True)
    for name in options.levers:
        if name not in LEVERS:
            raise SystemExit(f"unknown lever {name!r}; choose from {', '.join(LEVERS)}")
        for first in range(0, options.learners, SIDE_BY_SIDE):
            path = options.out / "records" / f"{name.replace(' ', '-')}-{options.frames}-{first}.json"
            if not path.exists():
                path.write_text(json.dumps(run(name, first, options)) + "\n", encoding="utf-8")
    records = read(options.out / "records")
    table = "\n".join([HEADER, *map(row, records)])
    print(table)
    (options.out / "table.md").write_text(table + "\n", encoding="utf-8")
    save_figure(draw(records), options.out / "learning_curves.png")


def run(lever: str, first: int, options: Options) -> dict[str, Any]:
    """Returns of the deterministic policies after every batch, [batches, learners]."""
    numbers: dict[str, Any] = {"num_envs": 5, **POLICY_GRADIENT_PRESETS[TASK], **LEVERS[lever]}
    count, num_envs = min(SIDE_BY_SIDE, options.learners - first), numbers.pop("num_envs")
    env = envs.make(TASK, learners=count, num_envs=num_envs, seed=0, first_learner=first, threads=1)
    # the schedule is that of a long run, however early this one stops
    learner = PolicyGradient(env, PolicyGradientConfig(**numbers), first_learner=first)
    starts = FixedStarts(TASK, count, options.episodes)
    frames, returns, since = [], [], time.process_time()
    for _ in learner.train():
        if learner.frames > WATCHED and learner.updates % 5:
            continue
        frames.append(learner.frames)
        returns.append(evaluate(starts, learner.policy).mean(-1).tolist())
        if learner.frames >= options.frames:
            break
    seconds = (time.process_time() - since) / count
    return {"lever": lever, "frames": frames, "returns": returns, "cpu_seconds": [seconds] * len(frames)}


def read(folder: Path) -> list[dict[str, Any]]:
    """All records, those of the same lever and length as one, in the order of `LEVERS`."""
    joined: dict[tuple[int, int], dict[str, Any]] = {}
    for path in sorted(folder.glob("*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        key = list(LEVERS).index(record["lever"]), record["frames"][-1]
        if key in joined:
            pairs = zip(joined[key]["returns"], record["returns"], strict=True)
            record["returns"] = [one + other for one, other in pairs]
        joined[key] = record
    return [joined[key] for key in sorted(joined)]


HEADER = """\
| lever | steps | solved | median steps to -200 | worst | relapses | last return, median | worst |
|---|---|---|---|---|---|---|---|"""


def row(record: dict[str, Any]) -> str:
    """One line of the table; relapses are the share of evaluations after the task was solved."""
    seeds = list(outcomes([record], THRESHOLD))
    steps = sorted(seed["frames"] for seed in seeds)
    solved = [seed["relapses"] for seed in seeds if seed["frames"] != NEVER]
    relapses = f"{np.mean(solved):.0%}" if solved else "–"
    last = [seed["last"] for seed in seeds]
    shown = [f"{value:,.0f}" if value != NEVER else "never" for value in (np.median(steps), steps[-1])]
    return (
        f"| {record['lever']} | {record['frames'][-1]:,} | {len(solved)} of {len(seeds)} | {shown[0]} | "
        f"{shown[1]} | {relapses} | {np.median(last):.0f} | {min(last):.0f} |"
    )


def draw(records: Sequence[dict[str, Any]]) -> Figure:
    """Median return of every lever's learners; all learners of the longest run."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    longest = max(records, key=lambda record: record["frames"][-1])
    for place, record in enumerate(record for record in records if record is not longest):
        style = "-" if place < COLOURS else "--"
        left.plot(record["frames"], np.median(record["returns"], axis=1), style, label=record["lever"])
    right.plot(longest["frames"], longest["returns"], color="#1f4e8c", alpha=0.4, linewidth=1)
    right.plot(longest["frames"], np.median(longest["returns"], axis=1), color="#1f4e8c", label="median")
    left.set_title("one number changed: median of the learners", fontsize="medium")
    right.set_title(f"{longest['lever']}: every learner", fontsize="medium")
    for axes in (left, right):
        axes.axhline(THRESHOLD, color="0.5", linewidth=0.8, linestyle="--")
        axes.set(xlabel="environment steps per learner", ylabel="return, deterministic policy")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize="x-small", loc="lower right")
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
