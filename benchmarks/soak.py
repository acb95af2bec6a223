"""A long run in bounded memory: resident memory of policy-gradient learning, measured as it goes.

    python -m benchmarks.soak [--frames 1000000] [--out benchmarks/results/soak.json]

What grows without bound (a basis, a cache, a log, a graph of gradients) shows as a slope. The first tenth is
warm-up: buffers fill, allocators find their size. The run passes if memory grows by less than `allowed` from
there on.
"""

import json
import os
import sys
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import envs
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig

MIB = 2**20
WARM_UP = 0.1  # of the run


@dataclass(frozen=True)
class Options:
    """What to run."""

    frames: int = 1_000_000  # environment steps, over all learners
    task: str = "pendulum-swingup"  # id of the task
    learners: int = 2  # side by side
    num_envs: int = 10  # of each learner
    allowed: float = 32.0  # MiB by which memory may grow after the warm-up
    out: Path | None = None  # JSON file


def resident() -> float:
    """Memory of this process that lies in RAM, MiB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def growth(frames: list[int], memory: list[float]) -> float:
    """MiB by which memory rises from the end of the warm-up to the end of the run, by a line through it.

    Args:
        frames: environment steps at each measurement, rising.
        memory: MiB at each.
    """
    steps, mib = np.asarray(frames, dtype=float), np.asarray(memory)
    warm = steps >= WARM_UP * steps[-1]
    slope, _ = np.polyfit(steps[warm], mib[warm], 1)
    return float(slope * (steps[-1] - steps[warm][0]))


def soak(options: Options) -> dict[str, Any]:
    """Train, and measure after every update."""
    env = envs.make(options.task, learners=options.learners, num_envs=options.num_envs, seed=0, threads=1)
    config = PolicyGradientConfig(total_frames=options.frames // options.learners)
    learner = PolicyGradient(env, config)
    frames, memory, begin = [0], [resident()], time.monotonic()
    figures: dict[str, Tensor] = {}
    for figures in learner.train():  # noqa: B007  (the last ones are reported)
        frames.append(learner.frames * options.learners)
        memory.append(resident())
    finite = all(bool(figure.isfinite().any()) for figure in figures.values())
    return {
        "date": date.today().isoformat(),
        "task": options.task,
        "frames": frames[-1],
        "seconds": round(time.monotonic() - begin, 1),
        "growth_mib": round(growth(frames, memory), 2),
        "memory_mib": {str(step): round(mib, 1) for step, mib in _thinned(frames, memory)},
        "return": [round(value, 1) for value in figures["return"].tolist()],
        "basis_size": figures["basis_size"].tolist(),
        "finite": finite,
    }


def _thinned(frames: list[int], memory: list[float]) -> list[tuple[int, float]]:
    chosen = np.unique(np.linspace(0, len(frames) - 1, 21).astype(int))
    return [(frames[i], memory[i]) for i in chosen]


def main(options: Options) -> int:
    """Soak, print, keep; the exit code tells whether memory stayed bounded."""
    torch.set_num_threads(1)
    found = soak(options)
    print(json.dumps(found, indent=1))
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(found["growth_mib"] > options.allowed)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
