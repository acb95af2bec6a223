"""What remembering is worth on other tasks: the presets of `train.py` against fresh rollouts alone.

    python -m benchmarks.gradient_presets [--tasks atwood]

Both arms have rollouts of the same length and a schedule of 12,000 steps. After every update the
deterministic policies play the same starts, those of Gymnasium's seeds 1000, 1001, ... Arms that --out holds
already are not run again; the table shows all.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import envs
from benchmarks.sample_efficiency import FixedStarts
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.runs import bootstrap_interval, evaluate
from train import ALL_EXPERIENCE, POLICY_GRADIENT_PRESETS

ENVIRONMENTS = 5  # of each learner
FRESH, REMEMBERED = "fresh rollouts alone, generalised advantages", "all experience"
EARLY = 3  # the table shows returns after this share of the steps, and at the end


@dataclass(frozen=True)
class Options:
    """What to run."""

    tasks: tuple[str, ...] = ("atwood", "cartpole-balance", "pendulum-swingup")  # ids
    learners: int = 5  # of each arm
    episodes: int = 20  # of an evaluation
    frames: int = 12_000  # environment steps per learner
    out: Path = Path("benchmarks/results/gradient_levers/presets.json")  # where the records go


def main(options: Options) -> None:
    """Run what has no record yet; print and write."""
    torch.set_num_threads(1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    records = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else []
    for task in options.tasks:
        for arm in (REMEMBERED, FRESH):
            if not any((record["task"], record["arm"]) == (task, arm) for record in records):
                records.append(run(task, arm, options))
                options.out.write_text(json.dumps(records) + "\n", encoding="utf-8")
    print("\n".join([HEADER, *map(row, records)]))


def run(task: str, arm: str, options: Options) -> dict[str, Any]:
    """Returns of the deterministic policies after every update, [updates, learners]."""
    preset = POLICY_GRADIENT_PRESETS.get(task, {})
    rollouts = {name: value for name, value in preset.items() if name not in ALL_EXPERIENCE}
    numbers: dict[str, Any] = {**(ALL_EXPERIENCE if arm == REMEMBERED else {}), **rollouts}
    numbers["total_frames"] = options.frames
    env = envs.make(task, learners=options.learners, num_envs=ENVIRONMENTS, seed=0, threads=1)
    learner = PolicyGradient(env, PolicyGradientConfig(**numbers))
    starts = FixedStarts(task, options.learners, options.episodes)
    frames, returns, seconds, since = [], [], 0.0, time.process_time()
    for _ in learner.train():
        seconds += time.process_time() - since
        frames.append(learner.frames)
        returns.append(evaluate(starts, learner.policy).mean(-1).tolist())
        since = time.process_time()
    spent = round(seconds / options.learners, 2)
    return {"task": task, "arm": arm, "frames": frames, "returns": returns, "cpu_seconds": spent}


HEADER = """\
| task | arm | learners | CPU s of each | steps | return | steps | return |
|---|---|---|---|---|---|---|---|"""


def row(record: dict[str, Any]) -> str:
    """One line of the table: mean returns with 95 % intervals over learners, early and at the end."""
    frames, returns = np.array(record["frames"]), np.array(record["returns"])
    cells = []
    for place in (int(np.argmax(frames >= frames[-1] / EARLY)), -1):
        low, high = bootstrap_interval(returns[place])
        cells.append(f"{frames[place]:,} | {returns[place].mean():.0f} [{low:.0f}, {high:.0f}]")
    head = f"| {record['task']} | {record['arm']} | {returns.shape[1]} | {record['cpu_seconds']:.1f} | "
    return head + " | ".join(cells) + " |"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
