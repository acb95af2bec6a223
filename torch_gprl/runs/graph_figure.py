"""The graph that a critic's kernel stands on, drawn over the value function (the thesis' Fig. .3)."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from torch_gprl.runs.figures import Surface, save_figure
from torch_gprl.runs.surfaces import PicturePlane

LONGEST = 0.5  # of the picture's width or height: a longer edge goes round the back, where the plane is cut


def graph_figure(surface: Surface, edges: Float[np.ndarray, "edges 2 2"], title: str = "") -> Figure:
    """Edges of a graph over the values of a plane.

    Args:
        surface: the values.
        edges: both ends of each edge, in the coordinates of the plane; those across its cut are not drawn.
        title: e.g. the task.
    """
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    axes = figure.add_subplot()
    mesh = axes.pcolormesh(surface.x, surface.y, surface.mean, cmap="viridis", shading="gouraud")
    figure.colorbar(mesh, ax=axes, label="posterior mean of V(s)", pad=0.02)
    size = np.array([np.ptp(surface.x), np.ptp(surface.y)])
    drawn = edges[(np.abs(edges[:, 1] - edges[:, 0]) < LONGEST * size).all(axis=1)]
    axes.add_collection(LineCollection(list(drawn), colors="white", linewidths=0.6, alpha=0.8))
    axes.plot(*drawn.reshape(-1, 2).T, "o", color="white", markersize=1.5)
    axes.set(xlabel=surface.labels[0], ylabel=surface.labels[1], title=title)
    axes.set(xlim=surface.x[[0, -1]], ylim=surface.y[[0, -1]])
    return figure


def save_graph(
    graphs: Iterable[Float[Tensor, "edges 2 S"]],
    surface: Surface,
    plane: PicturePlane,
    path: Path,
    title: str,
) -> None:
    """Draw a critic's graph, if it has one.

    Args:
        graphs: both ends of the edges of one graph, as observations, or nothing.
        surface: the values over the plane.
        plane: where observations lie.
        path: of the picture.
        title: e.g. the task.
    """
    for edges in graphs:
        places = plane.from_observation(edges).double().cpu().numpy()
        save_figure(graph_figure(surface, places, title), path)
