"""What each number gives: all-action policy gradients on Pendulum-v1 from batches of 200 steps.

    python -m benchmarks.gradient_levers                            every lever for 3,000 environment steps
    python -m benchmarks.gradient_levers --levers "as preset" --frames 13000 --learners 15 --episodes 100

The preset of `train.py` for this task, and the same with one number changed. After every batch, 40 steps of
five environments (later every fifth), the deterministic policy plays the same starts, those of Gymnasium's
seeds 1000, 1001, ... A learner has solved the task at the first of three evaluations in a row at -200 or
above; a relapse is a later evaluation below.

Every five learners leave a record in --out; a rerun skips what is there, and shows all in a table and a
picture. A call that would last too long stops after --minutes, and the next one goes on.
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
NO_MEAN = {"average_over": 1}  # of parameters: steps that are few are too far apart for it
LEVERS: dict[str, dict[str, Any]] = {
    "as preset": {},
    "the newest parameters act": NO_MEAN,
    "one episode per batch": {"num_envs": 1, "rollout_steps": 200},
    "one step of the policy per batch": NO_MEAN | {"improvements": 0},
    "undamped natural steps": {"damping": 1e-3},
    "learned exploration": {"exploration": "learned"},
    "discount 0.98": {"discount": 0.98},
    "the newest 1,000 steps alone": {"replay": 1_000},
    "noise of differences 0.001": {"noise": 0.001},
    "noise of differences 0.1": {"noise": 0.1},
    "state length scales 1": {"lengthscale": 1.0},
    "unit action length scale": {"action_lengthscale": 1.0},
    "half the basis": {"budget": 150},
    "half the basis, length scales 1, noise 0.001": {"budget": 150, "lengthscale": 1.0, "noise": 0.001},
    "generalised advantages, no replay": NO_MEAN
    | {"estimator": "generalised", "improvements": 0, "replay": 0, "rollout_steps": 200, "num_envs": 1},
}


@dataclass(frozen=True)
class Options:
    """What to compare."""

    levers: tuple[str, ...] = tuple(LEVERS)
    frames: int = 3_000  # environment steps per learner
    learners: int = 10  # of each lever
    episodes: int = 30  # of an evaluation
    minutes: float = 600.0  # of this call
    out: Path = Path("benchmarks/results/gradient_levers")  # where records, table and picture go


def main(options: Options) -> None:
    """Run what has no record yet; print, write, draw."""
    torch.set_num_threads(1)
    (options.out / "records").mkdir(parents=True, exist_ok=True)
    ends = time.monotonic() + 60 * options.minutes
    for name in options.levers:
        if name not in LEVERS:
            raise SystemExit(f"unknown lever {name!r}; choose from {', '.join(LEVERS)}")
        for first in range(0, options.learners, SIDE_BY_SIDE):
            path = options.out / "records" / f"{name.replace(' ', '-')}-{options.frames}-{first}.json"
            if not path.exists() and time.monotonic() < ends:
                run(name, first, options, path, ends)
    records = read(options.out / "records")
    if not records:
        raise SystemExit(f"no record is complete yet in {options.out}: call again")
    table = "\n".join([HEADER, *map(row, records)])
    print(table)
    (options.out / "table.md").write_text(table + "\n", encoding="utf-8")
    save_figure(draw(records), options.out / "learning_curves.png")


def run(lever: str, first: int, options: Options, path: Path, ends: float) -> None:
    """Leave a record in `path`: returns of the deterministic policies after every batch, [batches, learners].

    Past the time `ends` the run's state is left beside it, where the next call finds it.
    """
    numbers: dict[str, Any] = {"num_envs": 5, **POLICY_GRADIENT_PRESETS[TASK], **LEVERS[lever]}
    count, num_envs = min(SIDE_BY_SIDE, options.learners - first), numbers.pop("num_envs")
    env = envs.make(TASK, learners=count, num_envs=num_envs, seed=0, first_learner=first, threads=1)
    # the schedule is that of a long run, however early this one stops
    learner = PolicyGradient(env, PolicyGradientConfig(**numbers), first_learner=first)
    starts = FixedStarts(TASK, count, options.episodes)
    unfinished, since = path.with_suffix(".pt"), time.process_time()
    record: dict[str, Any] = {"lever": lever, "frames": [], "returns": [], "cpu_seconds": 0.0}
    if unfinished.exists():
        state = torch.load(unfinished, weights_only=True)
        learner.load_state_dict(state["learner"])
        record = state["record"]
    for _ in learner.train():
        if learner.frames <= WATCHED or learner.updates % 5 == 0:
            record["frames"].append(learner.frames)
            record["returns"].append(evaluate(starts, learner.policy).mean(-1).tolist())
        if learner.frames >= options.frames or time.monotonic() > ends:
            break
    record["cpu_seconds"] += (time.process_time() - since) / count
    if learner.frames < options.frames:
        torch.save({"learner": learner.state_dict(), "record": record}, unfinished)
        return
    path.write_text(json.dumps(record) + "\n", encoding="utf-8")
    unfinished.unlink(missing_ok=True)


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
    seeds = list(outcomes([record | {"cpu_seconds": record["frames"]}], THRESHOLD))
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
    figure = Figure(figsize=(12, 5), layout="constrained")
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
            below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 3}
            axes.legend(frameon=False, fontsize="x-small", **below)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
