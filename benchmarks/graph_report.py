"""What `graph_kernels` found, summed up over seeds: tables, and one line for each kernel in JSON."""

import json
import math
import statistics
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.graph_arms import EUCLIDEAN

DIGITS = 4


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


def show(scores: list[Score]) -> None:
    """Print means over seeds, and what each kernel gains over the best Euclidean one."""
    for problem, budget in dict.fromkeys((s.problem, s.budget) for s in scores):
        by_kernel = _by_kernel(scores, problem, budget)
        euclidean = min((_mean(by_kernel[k], "rmse") for k in EUCLIDEAN if k in by_kernel), default=math.nan)
        columns = (
            "seeds",
            "RMSE",
            "± seeds",
            "gain",
            "near",
            "far",
            "NLPD",
            "tune s",
            "learn s",
            "predict s",
        )
        table = Table("kernel", *columns, title=f"{problem}, {budget} basis vectors")
        for kernel, runs in by_kernel.items():
            rmse = _mean(runs, "rmse")
            spread = statistics.stdev(s.rmse for s in runs) if len(runs) > 1 else math.nan
            errors = [f"{_mean(runs, key):.3f}" for key in ("rmse_near", "rmse_far", "nlpd")]
            seconds = [f"{_mean(runs, key):.2f}" for key in ("tuning", "learning", "predicting")]
            gain = f"{1 - rmse / euclidean:+.0%}"
            table.add_row(kernel, str(len(runs)), f"{rmse:.3f}", f"{spread:.3f}", gain, *errors, *seconds)
        Console(width=150).print(table)


def write_summary(scores: list[Score], path: Path) -> None:
    """One line for each problem, budget and kernel: the errors of all seeds, and mean seconds."""
    lines = []
    for problem, budget in dict.fromkeys((s.problem, s.budget) for s in scores):
        for kernel, runs in _by_kernel(scores, problem, budget).items():
            errors = {
                key: [round(getattr(s, key), DIGITS) for s in runs]
                for key in ("rmse", "rmse_near", "rmse_far", "nlpd")
            }
            seconds = {key: round(_mean(runs, key), 3) for key in ("tuning", "learning", "predicting")}
            named = {"problem": problem, "budget": budget, "kernel": kernel, "seeds": [s.seed for s in runs]}
            lines.append(json.dumps({**named, **errors, **seconds}, ensure_ascii=False))
    path.write_text("[\n" + ",\n".join(lines) + "\n]\n")


def _by_kernel(scores: list[Score], problem: str, budget: int) -> dict[str, list[Score]]:
    here = sorted((s for s in scores if (s.problem, s.budget) == (problem, budget)), key=lambda s: s.seed)
    return {name: [s for s in here if s.kernel == name] for name in dict.fromkeys(s.kernel for s in here)}


def _mean(runs: list[Score], key: str) -> float:
    return statistics.fmean(getattr(score, key) for score in runs)
