"""Pictures of `graph_kernels`: the surfaces of the thesis' Fig. .3, and the graph over the state plane."""

import math
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.graph_machines import SPEED_UNIT, Jump
from benchmarks.graph_systems import Trajectories, Truth
from torch_gprl.graphs import Experience, NearestEdges, TransitionGraph

NODES = 100
NEIGHBOURS = 4
PANELS_PER_ROW = 4
FASTEST = Jump.extent[1]


def draw_surfaces(truth: Truth, surfaces: dict[str, Tensor], path: Path) -> None:
    """The true value and what each kernel made of it, on one scale."""
    shown = {"true value": truth.values, **surfaces}
    rows = -(-len(shown) // PANELS_PER_ROW)
    figure = Figure(figsize=(3.1 * PANELS_PER_ROW, 2.9 * rows), layout="constrained")
    panels = list(figure.subplots(rows, PANELS_PER_ROW, squeeze=False, sharex=True, sharey=True).flat)
    for axes, (name, values) in zip(panels, shown.items(), strict=False):
        _surface(axes, truth, values)
        rmse = float((values - truth.values).square().mean().sqrt())
        axes.set_title(name if values is truth.values else f"{name}: {rmse:.2f}", fontsize="small")
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    figure.supxlabel("angle from upright in rad", fontsize="small")
    figure.supylabel("speed in rad/s", fontsize="small")
    figure.savefig(path, dpi=130)


def draw_graph(truth: Truth, seen: Trajectories, path: Path) -> None:
    """Landmarks of the visited states as a graph, and all trajectories, over the true value."""
    states, next_states = seen.states.flatten(0, 1), seen.next_states.flatten(0, 1)
    visited = Experience(states.shape[-1], len(states), NODES)
    visited.add(states, next_states)
    graph = TransitionGraph(states.shape[-1], NODES, NearestEdges(NEIGHBOURS))
    graph.add(states[visited.landmarks])
    first, second = graph.lengths.isfinite().triu(1).nonzero().unbind(-1)
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes in (left, right):
        _surface(axes, truth, truth.values)
        axes.set_xlabel("angle from upright in rad")
    _lines(left, graph.points[first], graph.points[second], "white")
    angle, speed = _plane(graph.points).unbind(-1)
    left.plot(angle, speed, "o", color="white", markeredgecolor="black", markersize=3.5)
    left.set_title(f"graph of {NODES} landmarks, {int(graph.components())} part(s)", fontsize="medium")
    left.set_ylabel("speed in rad/s")
    _lines(right, states, next_states, "#d62728")
    right.set_title("visited transitions", fontsize="medium")
    figure.savefig(path, dpi=130)


def draw_connectivity(graphs: list[dict[str, object]], path: Path) -> None:
    """How dense graphs are, and into how many parts they fall, against the threshold of their edges."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, key in zip(figure.subplots(1, 2), ("mean degree", "parts"), strict=True):
        for problem in dict.fromkeys(str(graph["problem"]) for graph in graphs):
            rows = [
                (float(str(graph["edges"]).split()[-1]), graph[key])
                for graph in graphs
                if graph["problem"] == problem and str(graph["edges"]).startswith("threshold")
            ]
            axes.plot(*zip(*rows, strict=True), "o-", label=problem, markersize=4)
        axes.set(xlabel="threshold of equation (.18)", ylabel=key, yscale="symlog")
        axes.grid(alpha=0.25, linewidth=0.5)
    figure.axes[0].legend(frameon=False, fontsize="small")
    figure.suptitle(f"graphs of {NODES} spread-out states", fontsize="medium")
    figure.savefig(path, dpi=130)


def _surface(axes: Axes, truth: Truth, values: Tensor) -> None:
    cells = math.isqrt(len(values))
    low, high = float(truth.values.min()), float(truth.values.max())
    extent = (-math.pi, math.pi, -FASTEST, FASTEST)
    image = values.reshape(cells, cells).mT.numpy()
    axes.imshow(image, origin="lower", extent=extent, aspect="auto", vmin=low, vmax=high, cmap="viridis")


def _plane(points: Tensor) -> Tensor:
    """Angle and speed of inputs."""
    return torch.stack((torch.atan2(points[..., 1], points[..., 0]), SPEED_UNIT * points[..., 2]), -1)


def _lines(axes: Axes, start: Tensor, end: Tensor, color: str) -> None:
    """Edges that do not cross the cut at ±π."""
    segments = torch.stack((_plane(start), _plane(end)), -2)
    whole = (segments[:, 0, 0] - segments[:, 1, 0]).abs() < math.pi
    axes.add_collection(
        LineCollection(list(segments[whole].numpy()), colors=color, linewidths=0.6, alpha=0.8)
    )
    axes.set_ylim(-FASTEST, FASTEST)
