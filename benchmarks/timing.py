"""Timing side by side: competitors take turns in rounds, so that a noisy machine is noisy for all alike."""

import datetime
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np
import torch

Turn = Callable[[], int]
"""Does some work and returns how many units of it."""


def rates(
    turns: Mapping[str, Turn], rounds: int, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Units per second of each competitor: the median over rounds.

    Args:
        turns: what each does in one turn.
        rounds: how often each gets the machine.
        seconds: for how long each time; at least one turn.
        clock: seconds, monotonic.
    """
    seen: dict[str, list[float]] = {name: [] for name in turns}
    for _ in range(rounds):
        for name, turn in turns.items():
            units, start = 0, clock()
            while not units or clock() - start < seconds:
                units += turn()
            seen[name].append(units / (clock() - start))
    return {name: median(values) for name, values in seen.items()}


def matrix_product(size: int = 1024) -> Turn:
    """Turns of one float64 matrix product each; the units are floating point operations."""
    left, right = torch.randn(2, size, size, dtype=torch.float64)
    out = torch.empty_like(left)

    def turn() -> int:
        torch.mm(left, right, out=out)
        return 2 * size**3

    return turn


def exponent(values: Sequence[float], costs: Sequence[float]) -> float:
    """The p in cost ∝ valueᵖ that fits best, by least squares on the logarithms."""
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def machine() -> dict[str, object]:
    """Date, processor, threads, load and versions: what a figure means nothing without."""
    libraries = ("torch", "gpytorch", "scikit-learn", "numpy", "scipy")
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in libraries},
    }


def _processor() -> str:
    """The model's name where Linux tells, otherwise what Python knows of it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
