"""Pictures of `graph_kernels`: the surfaces of the thesis' Fig. .3, and the graph over a plane of states."""

import math
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.graph_systems import System, Trajectories, Truth
from torch_gprl.graphs import Experience, NearestEdges, TransitionGraph

NODES = 100
NEIGHBOURS = 4
PANELS_PER_ROW = 4


def draw_surfaces(system: System, truth: Truth, surfaces: dict[str, Tensor], path: Path) -> None:
    """The true value and what each kernel made of it, on one scale."""
    shown = {"true value": truth.values, **surfaces}
    rows = -(-len(shown) // PANELS_PER_ROW)
    figure = Figure(figsize=(3.1 * PANELS_PER_ROW, 2.9 * rows), layout="constrained")
    panels = list(figure.subplots(rows, PANELS_PER_ROW, squeeze=False, sharex=True, sharey=True).flat)
    for axes, (name, values) in zip(panels, shown.items(), strict=False):
        _surface(axes, system, truth, values)
        rmse = float((values - truth.values).square().mean().sqrt())
        axes.set_title(name if values is truth.values else f"{name}: {rmse:.2f}", fontsize="small")
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    figure.supxlabel(system.axes[0], fontsize="small")
    figure.supylabel(system.axes[1], fontsize="small")
    figure.savefig(path, dpi=130)


def draw_graph(system: System, truth: Truth, seen: Trajectories, path: Path) -> None:
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
        _surface(axes, system, truth, truth.values)
        axes.set_xlabel(system.axes[0])
    _lines(left, system, graph.points[first], graph.points[second], "white")
    left.plot(
        *system.plane(graph.points).unbind(-1), "o", color="white", markeredgecolor="black", markersize=3.5
    )
    left.set_title(f"{NODES} landmarks, each with its {NEIGHBOURS} nearest", fontsize="medium")
    left.set_ylabel(system.axes[1])
    _lines(right, system, states, next_states, "#d62728")
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


def _surface(axes: Axes, system: System, truth: Truth, values: Tensor) -> None:
    cells = math.isqrt(len(values))
    low, high = float(truth.values.min()), float(truth.values.max())
    width, height = system.extent
    image = values.reshape(cells, cells).mT.numpy()
    extent = (-width, width, -height, height)
    axes.imshow(image, origin="lower", extent=extent, aspect="auto", vmin=low, vmax=high, cmap="viridis")


def _lines(axes: Axes, system: System, start: Tensor, end: Tensor, color: str) -> None:
    """Edges, but those across the cut of an angle."""
    segments = torch.stack((system.plane(start), system.plane(end)), -2)
    width, height = system.extent
    whole = (segments[:, 0, 0] - segments[:, 1, 0]).abs() < width
    axes.add_collection(
        LineCollection(list(segments[whole].numpy()), colors=color, linewidths=0.6, alpha=0.8)
    )
    axes.set(xlim=(-width, width), ylim=(-height, height))
