"""What `sample_efficiency` measured: when thresholds were crossed, at what cost, and what came after."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.sample_arms import Goal

SUSTAINED = 3  # evaluations in a row above a threshold
NEVER = float("inf")
Records = Sequence[dict[str, Any]]


def read(folder: Path) -> list[dict[str, Any]]:
    """All records, in the order of their names."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]


def crossing(returns: Float[np.ndarray, " evaluations"], threshold: float) -> int | None:
    """The first of `SUSTAINED` evaluations in a row at or above a threshold; None if there is none."""
    above = np.convolve(returns >= threshold, np.ones(SUSTAINED), mode="valid") == SUSTAINED
    return int(above.argmax()) if above.any() else None


def outcomes(records: Records, threshold: float) -> Iterator[dict[str, float]]:
    """For every seed: steps and CPU seconds to the threshold, share of relapses after it, last return."""
    for record in records:
        for returns in np.array(record["returns"]).T:
            first = crossing(returns, threshold)
            crossed = first is not None
            yield {
                "frames": record["frames"][first] if crossed else NEVER,
                "cpu_seconds": record["cpu_seconds"][first] if crossed else NEVER,
                "relapses": float(np.mean(returns[first:] < threshold)) if crossed else NEVER,
                "last": float(returns[-1]),
            }


def summarise(records: Records, goals: Mapping[str, Goal]) -> list[dict[str, Any]]:
    """One row for each task, threshold and arm that has records."""
    rows = []
    for task, goal in goals.items():
        for threshold in goal.thresholds:
            for arm in dict.fromkeys(record["arm"] for record in records if record["task"] == task):
                own = [record for record in records if (record["task"], record["arm"]) == (task, arm)]
                rows.append({"task": task, "threshold": threshold, "arm": arm, **_row(own, threshold)})
    return rows


def _row(records: Records, threshold: float) -> dict[str, Any]:
    seeds = list(outcomes(records, threshold))
    frames, relapses = ([seed[key] for seed in seeds] for key in ("frames", "relapses"))
    settled = [share for share in relapses if share != NEVER]
    return {
        "seeds": len(seeds),
        "solved": len(settled),
        "median_frames": _finite(median(frames)),
        "worst_frames": _finite(max(frames)),
        "median_cpu_seconds": _finite(median(seed["cpu_seconds"] for seed in seeds)),
        "relapsed": sum(share > 0 for share in settled),
        "mean_relapses": float(np.mean(settled)) if settled else None,
        "median_last_return": median(seed["last"] for seed in seeds),
        "frames_in_all": max(record["frames"][-1] for record in records),
    }


def _finite(value: float) -> float | None:
    """JSON knows no infinity: None stands for never."""
    return None if value == NEVER else value


def print_table(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """All rows on the terminal."""
    heads = ("steps: median", "worst", "CPU s", "solved", "relapsed", "share below", "last return")
    table = Table("task", "return", "arm", *heads)
    for row in rows:
        never = f"never in {row['frames_in_all']:,}"
        table.add_row(
            row["task"],
            f"{row['threshold']:g}",
            row["arm"],
            *(never if row[key] is None else f"{row[key]:,.0f}" for key in ("median_frames", "worst_frames")),
            "" if row["median_cpu_seconds"] is None else f"{row['median_cpu_seconds']:.1f}",
            f"{row['solved']} of {row['seeds']}",
            f"{row['relapsed']}",
            "" if row["mean_relapses"] is None else f"{row['mean_relapses']:.0%}",
            f"{row['median_last_return']:.1f}",
        )
    console.print(table)


def write(
    rows: Sequence[dict[str, Any]], records: Records, goals: Mapping[str, Goal], out: Path
) -> list[Path]:
    """`summary.json` and the learning curves."""
    out.mkdir(parents=True, exist_ok=True)
    summary, picture = out / "summary.json", out / "learning_curves.png"
    machines = {(r["machine"]["date"], r["machine"]["processor"]): r["machine"] for r in records}
    result = {"rows": list(rows), "machines": list(machines.values())}
    summary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    draw(records, goals).savefig(picture, dpi=110)
    return [summary, picture]


def draw(records: Records, goals: Mapping[str, Goal]) -> Figure:
    """One panel for each task: median and range over seeds of every arm, against experience."""
    tasks = [task for task in goals if any(record["task"] == task for record in records)]
    columns = min(3, max(1, len(tasks)))
    rows = max(1, -(-len(tasks) // columns))
    figure = Figure(figsize=(4.6 * columns, 3.6 * rows), layout="constrained")
    arms = list(dict.fromkeys(record["arm"] for record in records))
    places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for empty in places[len(tasks) :]:
        empty.remove()
    for axes, task in zip(places, tasks, strict=False):
        for arm in arms:
            own = [record for record in records if (record["task"], record["arm"]) == (task, arm)]
            if own:
                shared = min(len(record["frames"]) for record in own)
                returns = np.concatenate([np.array(record["returns"])[:shared] for record in own], 1)
                frames, colour = own[0]["frames"][:shared], f"C{arms.index(arm)}"
                axes.plot(
                    frames, np.median(returns, 1), color=colour, label=f"{arm}, {returns.shape[1]} seeds"
                )
                axes.fill_between(
                    frames, returns.min(1), returns.max(1), color=colour, alpha=0.15, linewidth=0
                )
        for threshold in goals[task].thresholds:
            axes.axhline(threshold, color="0.4", linestyle="--", linewidth=0.8)
        axes.set(xscale="log", title=task, xlabel="environment steps", ylabel="return")
        axes.xaxis.set_minor_formatter("")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize="x-small")
    return figure
