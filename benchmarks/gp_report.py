"""What `gp_updates` measured, as tables on the terminal, as JSON, and as one picture."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.gp_peers import OURS, PEERS
from benchmarks.timing import exponent

Rows = Sequence[dict[str, Any]]
VARIABLES = {"budget": "budget", "block": "points per block", "dims": "input dimensions"}


def by_peer(rows: Rows) -> dict[str, list[dict[str, Any]]]:
    """The rows of each peer that was measured."""
    groups = {peer: [row for row in rows if row["peer"] == peer] for peer in PEERS}
    return {peer: own for peer, own in groups.items() if own}


def exponents(rows: Rows) -> dict[str, float]:
    """How the cost of a point grows with the variable, for each peer measured at two values or more."""
    growth = {}
    for peer, own in by_peer(rows).items():
        if len(own) > 1:
            costs = [1 / row["updates_per_second"] for row in own]
            growth[peer] = exponent([row["value"] for row in own], costs)
    return growth


def print_tables(results: dict[str, Any], console: Console) -> None:
    """Everything that was measured, one table a section."""
    machine = results["machine"]
    console.print(
        f"{machine['date']}, {machine['processor']}, {machine['threads']} thread, load {machine['load']:.1f}"
    )
    console.print(_streams_table(results["streams"], results["setting"]))
    console.print(_accuracy_table(results["accuracy"]))
    for variable in VARIABLES:
        console.print(_growth_table(variable, results[variable]))
    console.print(_plain_table("A settled basis beside the machine's matrix product", results["settled"]))
    console.print(_plain_table("Points/s over all learners", results["learners"]))
    console.print(_prediction_table(results["prediction"]))


def write(results: dict[str, Any], out: Path) -> tuple[Path, Path]:
    """JSON to `out`, with the exponents, and the picture beside it; returns both paths."""
    out.parent.mkdir(parents=True, exist_ok=True)
    growth = {variable: exponents(results[variable]) for variable in VARIABLES}
    out.write_text(json.dumps({**results, "exponents": growth}, indent=1) + "\n", encoding="utf-8")
    picture = out.with_suffix(".png")
    draw(results, picture)
    return out, picture


def draw(results: dict[str, Any], path: Path) -> None:
    """Updates per second by stream, budget and block size, and the gain of many learners in one program."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    _draw_streams(axes[0, 0], results["streams"])
    for axis, variable in ((axes[0, 1], "budget"), (axes[1, 0], "block")):
        for peer, rows in by_peer(results[variable]).items():
            values = [row["value"] for row in rows], [row["updates_per_second"] for row in rows]
            axis.loglog(*values, "o-", label=peer, linewidth=2.5 if peer == OURS else 1)
        axis.set(xlabel=VARIABLES[variable], ylabel="updates/s", title=f"Every point novel, by {variable}")
        axis.grid(alpha=0.3)
    _draw_learners(axes[1, 1], results["learners"])
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(PEERS))
    machine = results["machine"]
    figure.suptitle(f"{machine['processor']}, one thread, float64, {machine['date']}", fontsize=9)
    figure.savefig(path, dpi=110)


def _draw_streams(axis: Axes, rows: Rows) -> None:
    streams = list(dict.fromkeys(row["stream"] for row in rows))
    groups = by_peer(rows)
    height = 0.8 / len(groups)
    for number, (peer, own) in enumerate(groups.items()):
        places = [streams.index(row["stream"]) + number * height for row in own]
        axis.barh(places, [row["updates_per_second"] for row in own], height, label=peer)
    axis.set_yticks([place + 0.4 - height / 2 for place in range(len(streams))], streams)
    axis.invert_yaxis()
    axis.set(xscale="log", xlabel="updates/s", title="By stream")


def _draw_learners(axis: Axes, rows: Rows) -> None:
    for block in dict.fromkeys(row["block"] for row in rows):
        own = [row for row in rows if row["block"] == block]
        axis.plot(
            [row["learners"] for row in own], [row["ratio"] for row in own], "o-", label=f"blocks of {block}"
        )
    axis.axhline(1, color="grey", linewidth=0.8)
    axis.set(xscale="log", xlabel="learners", ylabel="one program / one after the other", title="Throughput")
    axis.legend(fontsize=7)


def _streams_table(rows: Rows, setting: dict[str, int]) -> Table:
    title = f"Budget {setting['budget']}, blocks of {setting['block']}; ratio: ours / theirs"
    table = _table(title, ("stream", "peer", "updates/s", "ratio"))
    for row in rows:
        ratio = "" if row["peer"] == OURS else f"{row['ratio']:.1f}"
        table.add_row(row["stream"], row["peer"], f"{row['updates_per_second']:,.0f}", ratio)
    return table


def _accuracy_table(rows: Rows) -> Table:
    title = f"Errors on held-out data, mean of {rows[0]['seeds']} draws"
    table = _table(title, ("stream", "peer", "points", "RMSE", "NLPD"))
    for row in rows:
        errors = (f"{row[name]:.4f}" for name in ("rmse", "nlpd"))
        table.add_row(row["stream"], row["peer"], f"{row['points']:,}", *errors)
    return table


def _growth_table(variable: str, rows: Rows) -> Table:
    values = sorted({row["value"] for row in rows})
    title = f"Updates/s by {VARIABLES[variable]}, every point novel; cost of a point ∝ {variable}^p"
    table = _table(title, ("peer", *map(str, values), "p"))
    growth = exponents(rows)
    for peer, own in by_peer(rows).items():
        speeds = {row["value"]: f"{row['updates_per_second']:,.0f}" for row in own}
        fitted = f"{growth[peer]:.2f}" if peer in growth else ""
        table.add_row(peer, *(speeds.get(value, "–") for value in values), fitted)
    return table


def _prediction_table(rows: Rows) -> Table:
    counts = sorted({row["points"] for row in rows})
    table = _table("Mean and variance, in ms", ("peer", *(f"{count} points" for count in counts)))
    for peer, own in by_peer(rows).items():
        table.add_row(peer, *(f"{1e3 * row['seconds']:.3f}" for row in own))
    return table


def _plain_table(title: str, rows: Rows) -> Table:
    table = _table(title, tuple(rows[0]) if rows else ())
    for row in rows:
        table.add_row(
            *(f"{value:,.2f}" if isinstance(value, float) else str(value) for value in row.values())
        )
    return table


def _table(title: str, columns: Iterable[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE)
    for number, column in enumerate(columns):
        left = number == 0 or column == "peer"
        table.add_column(column, justify="left" if left else "right", no_wrap=left)
    return table
