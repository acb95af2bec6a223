"""What `graph_kernels` found, summed up over seeds: tables, and one line for each kernel in JSON."""

import json
import math
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table
from scipy.stats import t

from benchmarks.graph_arms import EUCLIDEAN
from benchmarks.graph_spread import Inner, error_file, inner_products, split, variance_ratio

DIGITS = 4
SPREADS = ("squared_bias", "variance", "variance_in_parts")
COLUMNS = (
    *("seeds", "RMSE", "spread", "gain", "± 95 %", "bias²", "variance", "parts", "near", "far"),
    *("NLPD", "gain", "± 95 %", "tune s", "learn s", "predict s"),
)


@dataclass(frozen=True)
class Score:
    """Errors in standard deviations of the value, and seconds."""

    problem: str
    kernel: str
    budget: int
    seed: int
    rmse: float
    rmse_near: float  # within two cells of a discontinuity
    rmse_far: float
    nlpd: float  # negative log predictive density of the true value
    tuning: float  # s
    learning: float  # s, shared with the other budgets
    predicting: float  # s, for all states that are judged


def show(scores: list[Score], folder: Path) -> None:
    """Print means over seeds, and what each kernel gains over the best Euclidean one."""
    for problem, budget in dict.fromkeys((s.problem, s.budget) for s in scores):
        by_kernel = _by_kernel(scores, problem, budget)
        table = Table("kernel", *COLUMNS, title=f"{problem}, {budget} basis vectors")
        spreads = _spreads(by_kernel, folder)
        for kernel, runs in by_kernel.items():
            spread = statistics.stdev(s.rmse for s in runs) if len(runs) > 1 else math.nan
            error, fewer = paired_gain(by_kernel, kernel, "rmse"), paired_gain(by_kernel, kernel, "nlpd")
            best = error.mean + _mean(runs, "rmse")
            near, far, *seconds = (
                f"{_mean(runs, key):.2f}"
                for key in ("rmse_near", "rmse_far", "tuning", "learning", "predicting")
            )
            gained = f"{error.mean / best:+.0%}", f"± {error.half / best:.0%}"
            density = f"{_mean(runs, 'nlpd'):.2f}", f"{fewer.mean:+.2f}", f"± {fewer.half:.2f}"
            shown = f"{_mean(runs, 'rmse'):.3f}", f"{spread:.3f}"
            parts = [str(spreads.get(kernel, {}).get(key, "")) for key in SPREADS]
            table.add_row(kernel, str(len(runs)), *shown, *gained, *parts, near, far, *density, *seconds)
        Console(width=190).print(table)


class Gain(NamedTuple):
    """How much less a kernel has of something, and half of the 95 % interval of that."""

    mean: float
    half: float


def paired_gain(by_kernel: dict[str, list[Score]], kernel: str, key: str) -> Gain:
    """What a kernel spares against the Euclidean one that is best on average, paired by seed."""
    rivals = [by_kernel[name] for name in EUCLIDEAN if name in by_kernel]
    if not rivals:
        return Gain(math.nan, math.nan)
    best = {s.seed: getattr(s, key) for s in min(rivals, key=lambda runs: _mean(runs, key))}
    spared = [best[s.seed] - getattr(s, key) for s in by_kernel[kernel] if s.seed in best]
    if len(spared) < 2:
        return Gain(spared[0] if spared else math.nan, math.nan)
    error = statistics.stdev(spared) / math.sqrt(len(spared))
    return Gain(statistics.fmean(spared), float(t.ppf(0.975, len(spared) - 1)) * error)


def write_summary(scores: list[Score], folder: Path) -> None:
    """graph_kernels.json: for each problem, budget and kernel the errors of all seeds, and mean seconds."""
    lines = []
    for problem, budget in dict.fromkeys((s.problem, s.budget) for s in scores):
        by_kernel = _by_kernel(scores, problem, budget)
        spreads = _spreads(by_kernel, folder)
        for kernel, runs in by_kernel.items():
            errors = {
                key: [round(getattr(s, key), DIGITS) for s in runs]
                for key in ("rmse", "rmse_near", "rmse_far", "nlpd")
            }
            seconds = {key: round(_mean(runs, key), 3) for key in ("tuning", "learning", "predicting")}
            named = {"problem": problem, "budget": budget, "kernel": kernel, "seeds": [s.seed for s in runs]}
            line = {**named, **errors, **spreads.get(kernel, {}), **seconds}
            lines.append(json.dumps(line, ensure_ascii=False))
    (folder / "graph_kernels.json").write_text("[\n" + ",\n".join(lines) + "\n]\n")


def _spreads(by_kernel: dict[str, list[Score]], folder: Path) -> dict[str, dict[str, object]]:
    """Squared bias and variance of each kernel, the latter also in parts of the best Euclidean kernel's.

    That is the one of the least mean RMSE: a prior that hardly learns has no variance. With its interval, on
    the seeds that both have learned from. There must be two seeds.
    """
    rivals = [name for name in by_kernel if name in EUCLIDEAN]
    best = by_kernel[min(rivals, key=lambda name: _mean(by_kernel[name], "rmse"))] if rivals else []
    found: dict[str, dict[str, object]] = {}
    for name, runs in by_kernel.items():
        if len(runs) < 2:
            continue
        bias, variance = split(_inner_products(runs, folder))
        found[name] = {"squared_bias": round(bias, DIGITS + 1), "variance": round(variance, DIGITS + 1)}
        shared = {s.seed for s in runs} & {s.seed for s in best}
        if len(shared) > 1:
            pair = ([s for s in part if s.seed in shared] for part in (runs, best))
            ratio = variance_ratio(*(_inner_products(part, folder) for part in pair))
            found[name]["variance_in_parts"] = [round(number, 2) for number in ratio]
    return found


def _inner_products(runs: list[Score], folder: Path) -> Inner:
    return inner_products([error_file(folder, s.problem, s.kernel, s.seed) for s in runs], runs[0].budget)


def _by_kernel(scores: list[Score], problem: str, budget: int) -> dict[str, list[Score]]:
    here = sorted((s for s in scores if (s.problem, s.budget) == (problem, budget)), key=lambda s: s.seed)
    return {name: [s for s in here if s.kernel == name] for name in dict.fromkeys(s.kernel for s in here)}


def _mean(runs: list[Score], key: str) -> float:
    return statistics.fmean(getattr(score, key) for score in runs)
