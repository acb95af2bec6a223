"""Pictures of a run: the learning curve, and a value function over a plane of states.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot and its global state: no display is
needed and nothing has to be closed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Num
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from torch_gprl.runs.intervals import bootstrap_interval

FEWEST_FOR_INTERVAL = 5  # learners; a bootstrap of fewer is much too narrow
COLOUR = "#1f4e8c"
DOTS_PER_INCH = 200
PANELS_IN_A_ROW = 3


def learning_curve(
    frames: Num[np.ndarray, " updates"],
    returns: Float[np.ndarray, "updates learners"],
    threshold: float | None = None,
    title: str = "",
) -> Figure:
    """Mean return over learners against experience, each learner as a thin line.

    The band is the 95 % bootstrap interval of the mean from five learners on, the range from the worst to the
    best with fewer; the legend says which.

    Args:
        frames: environment steps per learner at each update.
        returns: return of each learner at each update; NaN where there is none yet.
        threshold: return that counts as solved, drawn as a line.
        title: e.g. the task.
    """
    learners = returns.shape[1]
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    if learners > 1:
        label, low, high = _band(returns)
        axes.plot(frames, returns, color="0.72", linewidth=0.5)
        axes.fill_between(frames, low, high, color=COLOUR, alpha=0.35, linewidth=0, label=label, zorder=2)
    label = f"mean of {learners} learners" if learners > 1 else "return"
    axes.plot(frames, returns.mean(axis=1), color=COLOUR, linewidth=1.8, label=label)
    if threshold is not None:
        axes.axhline(threshold, color="0.35", linestyle="--", linewidth=1, label=f"solved: {threshold:g}")
    axes.set(xlabel="environment steps per learner", ylabel="return per episode", title=title)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    open_frame(axes)
    axes.legend(frameon=False, fontsize="small", loc="best")
    return figure


def compare_curves(
    curves: Mapping[str, tuple[Num[np.ndarray, " updates"], Float[np.ndarray, "updates learners"]]],
    metric: str,
) -> Figure:
    """Mean over learners of several runs against experience, each with its band as in `learning_curve`.

    Args:
        curves: name of the run -> environment steps per learner, and the metric of each learner.
        metric: what the values are.
    """
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.add_subplot()
    for place, (name, (frames, values)) in enumerate(curves.items()):
        colour = f"C{place % 10}"
        learners = values.shape[1]
        if learners > 1:
            band, low, high = _band(values)
            axes.fill_between(frames, low, high, color=colour, alpha=0.2, linewidth=0, label=band)
        label = f"{name}, mean of {learners} learners" if learners > 1 else name
        axes.plot(frames, values.mean(axis=1), color=colour, linewidth=1.8, label=label)
    axes.set(xlabel="environment steps per learner", ylabel=metric)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    open_frame(axes)
    axes.legend(frameon=False, fontsize="small", loc="best")
    return figure


def metric_panels(
    frames: Num[np.ndarray, " updates"], metrics: Mapping[str, Float[np.ndarray, "updates learners"]]
) -> Figure:
    """One small panel for each metric: its mean over learners, and the range from the worst to the best.

    Args:
        frames: environment steps per learner at each update.
        metrics: name -> values of each learner; NaN where there is none yet.
    """
    rows = max(1, -(-len(metrics) // PANELS_IN_A_ROW))
    figure = Figure(figsize=(9.2, 2.1 * rows), layout="constrained")
    grid = figure.subplots(rows, PANELS_IN_A_ROW, sharex=True, squeeze=False).ravel()
    for axes, (name, values) in zip(grid, metrics.items(), strict=False):
        axes.fill_between(
            frames, values.min(axis=1), values.max(axis=1), color=COLOUR, alpha=0.25, linewidth=0
        )
        axes.plot(frames, values.mean(axis=1), color=COLOUR, linewidth=1.2)
        axes.set_title(name.replace("_", " "), fontsize="medium")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        open_frame(axes)
    for axes in grid[len(metrics) :]:
        axes.set_visible(False)
    figure.supxlabel("environment steps per learner", fontsize="small")
    return figure


def _band(
    returns: Float[np.ndarray, "updates learners"],
) -> tuple[str, Float[np.ndarray, " updates"], Float[np.ndarray, " updates"]]:
    """Name, lower and upper edge of the band."""
    if returns.shape[1] >= FEWEST_FOR_INTERVAL:
        return "95 % bootstrap interval of the mean", *bootstrap_interval(returns)
    return "worst to best learner", returns.min(axis=1), returns.max(axis=1)


@dataclass(frozen=True)
class Surface:
    """A value function on a rectangular grid of a plane of states.

    Attributes:
        x, y: the grid's coordinates, in the units that `labels` names.
        mean: posterior mean of the value, in units of the return.
        stddev: posterior standard deviation of the value, in units of the return.
        basis: the basis vectors' places on the plane; those outside the grid are not drawn.
        labels: what x and y are, with their units.
    """

    x: Float[np.ndarray, " columns"]
    y: Float[np.ndarray, " rows"]
    mean: Float[np.ndarray, "rows columns"]
    stddev: Float[np.ndarray, "rows columns"]
    basis: Float[np.ndarray, "size 2"]
    labels: tuple[str, str]


def value_surface(surface: Surface, title: str = "") -> Figure:
    """Two panels: V(s) = Q(s, f(s)), and how uncertain it is, with the basis vectors that carry it.

    Args:
        surface: what to draw.
        title: e.g. the task.
    """
    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    if title:
        figure.suptitle(title)
    panels = [
        ("value V(s) = Q(s, f(s))", surface.mean, "viridis", "posterior mean"),
        ("uncertainty of V(s)", surface.stddev, "magma", "posterior standard deviation"),
    ]
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (name, values, colours, unit) in zip((left, right), panels, strict=True):
        mesh = axes.pcolormesh(surface.x, surface.y, values, cmap=colours, shading="gouraud", rasterized=True)
        figure.colorbar(mesh, ax=axes, label=unit, pad=0.02)
        axes.scatter(*surface.basis.T, s=11, facecolor="white", edgecolor="black", linewidth=0.6)
        axes.set(title=name, xlabel=surface.labels[0])
        axes.set(xlim=surface.x[[0, -1]], ylim=surface.y[[0, -1]])
        axes.title.set_size("medium")
    left.set_ylabel(surface.labels[1])
    figure.supxlabel(_basis_note(surface), fontsize="small", color="0.3")
    return figure


def _basis_note(surface: Surface) -> str:
    """How many basis vectors there are, and how many of them the picture shows."""
    corners = np.array([[surface.x[0], surface.y[0]], [surface.x[-1], surface.y[-1]]])
    shown = int(((surface.basis >= corners[0]) & (surface.basis <= corners[1])).all(axis=1).sum())
    outside = len(surface.basis) - shown
    return f"○ {shown} basis vectors" + (f", {outside} more outside the picture" if outside else "")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure; the ending of the path says how (`.png`, `.pdf`, `.svg`)."""
    figure.savefig(path, dpi=DOTS_PER_INCH)


def open_frame(axes: Axes) -> None:
    """Draw only the axes' lines that carry a scale, and a light grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0)
    axes.grid(alpha=0.25, linewidth=0.5)
