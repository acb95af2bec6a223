"""The picture of a graph over the value function: which edges it shows."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from torch_gprl.runs import Surface, graph_figure


def test_edges_are_drawn_but_for_those_across_the_cut():
    x, y = np.linspace(-3, 3, 7), np.linspace(-1, 1, 5)
    surface = Surface(x, y, np.zeros((5, 7)), np.ones((5, 7)), np.zeros((0, 2)), ("angle in rad", "speed"))
    edges = np.array([[[0.0, 0.0], [1.0, 0.5]], [[-2.9, 0.0], [2.9, 0.1]]])
    figure = graph_figure(surface, edges, "pendulum")
    axes = figure.axes[0]
    (lines,) = [part for part in axes.collections if isinstance(part, LineCollection)]
    (segment,) = lines.get_segments()
    assert segment == pytest.approx(edges[0])
    assert axes.get_title() == "pendulum"
    assert axes.get_xlim() == (-3, 3)
