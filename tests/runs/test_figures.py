"""Figures: what is drawn is what was given, and the labels say what it is."""

import dataclasses

import matplotlib.image
import numpy as np
import pytest

from torch_gprl.runs import (
    Surface,
    bootstrap_interval,
    compare_curves,
    learning_curve,
    save_figure,
    value_surface,
)
from torch_gprl.runs.figures import metric_panels

FRAMES = np.array([100, 200, 300, 400])


def returns(learners: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(4, learners)).cumsum(axis=0)


def labels(figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def band(figure) -> np.ndarray:
    """Lower and upper edge of the filled band at FRAMES."""
    (patch,) = figure.axes[0].collections
    vertices = patch.get_paths()[0].vertices
    edges = [vertices[vertices[:, 0] == frames, 1] for frames in FRAMES]
    return np.array([[edge.min() for edge in edges], [edge.max() for edge in edges]])


@pytest.mark.parametrize("learners", [1, 3, 20])
def test_the_mean_is_drawn_with_a_line_for_each_learner(learners):
    values = returns(learners)
    lines = learning_curve(FRAMES, values).axes[0].get_lines()
    drawn = np.stack([line.get_ydata() for line in lines])
    expected = [*values.T, values.mean(axis=1)] if learners > 1 else [values[:, 0]]
    assert drawn == pytest.approx(np.stack(expected))


def test_many_learners_get_the_interval_of_the_mean():
    figure = learning_curve(FRAMES, returns(20))
    assert band(figure) == pytest.approx(np.stack(bootstrap_interval(returns(20))))
    assert labels(figure) == ["95 % bootstrap interval of the mean", "mean of 20 learners"]


def test_few_learners_get_their_range():
    figure = learning_curve(FRAMES, returns(3))
    assert band(figure) == pytest.approx(np.stack([returns(3).min(axis=1), returns(3).max(axis=1)]))
    assert labels(figure) == ["worst to best learner", "mean of 3 learners"]


def test_one_learner_gets_no_band():
    figure = learning_curve(FRAMES, returns(1))
    assert len(figure.axes[0].collections) == 0
    assert labels(figure) == ["return"]


def test_the_threshold_is_drawn_and_named():
    figure = learning_curve(FRAMES, returns(1), threshold=150.0)
    assert figure.axes[0].get_lines()[-1].get_ydata() == [150.0, 150.0]
    assert labels(figure)[-1] == "solved: 150"


def a_surface() -> Surface:
    x, y = np.linspace(-3, 3, 7), np.linspace(-1, 1, 5)
    mean = x[None, :] + 10 * y[:, None]
    return Surface(
        x, y, mean, stddev=1 + mean**2, basis=np.array([[0.5, 0.2], [2.0, -1.0]]), labels=("a", "b")
    )


def test_a_surface_shows_value_and_uncertainty_over_the_plane():
    surface = a_surface()
    figure = value_surface(surface)
    for axes, values in zip(figure.axes, (surface.mean, surface.stddev), strict=False):
        mesh, points = axes.collections
        assert np.asarray(mesh.get_array()) == pytest.approx(values)
        assert mesh.get_coordinates()[1, 2].tolist() == pytest.approx([surface.x[2], surface.y[1]])
        assert np.asarray(points.get_offsets()) == pytest.approx(surface.basis)
        assert axes.get_xlabel() == "a"
        assert axes.get_xlim() == (-3, 3)
        assert axes.get_ylim() == (-1, 1)
    assert figure.axes[0].get_ylabel() == "b"


@pytest.mark.parametrize(
    ("places", "note"),
    [
        ([[0.5, 0.2], [3.0, -1.0]], "○ 2 basis vectors"),
        ([[0.5, 0.2], [3.1, 0.0], [0.0, -1.1]], "○ 1 basis vectors, 2 more outside the picture"),
        ([], "○ 0 basis vectors"),
    ],
)
def test_a_surface_counts_its_basis_vectors(places, note):
    surface = dataclasses.replace(a_surface(), basis=np.array(places, dtype=float).reshape(-1, 2))
    assert value_surface(surface).get_supxlabel() == note


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_a_figure_becomes_a_file(tmp_path, ending):
    path = tmp_path / f"surface.{ending}"
    save_figure(value_surface(a_surface(), "pendulum"), path)
    assert path.stat().st_size > 5000
    if ending == "png":
        assert matplotlib.image.imread(path).std() > 0.1


def test_runs_are_compared_with_the_band_of_each():
    few, many = returns(3), returns(20)
    figure = compare_curves(
        {"few": (FRAMES, few), "many": (FRAMES, many), "one": (FRAMES, few[:, :1])}, "sigma"
    )
    axes = figure.axes[0]
    drawn = [line.get_ydata() for line in axes.get_lines()]
    assert drawn == [pytest.approx(few.mean(1)), pytest.approx(many.mean(1)), pytest.approx(few[:, 0])]
    edges = [patch.get_paths()[0].vertices[:, 1] for patch in axes.collections]
    assert [edge.max() for edge in edges] == pytest.approx([few.max(), bootstrap_interval(many)[1].max()])
    assert labels(figure) == [
        "worst to best learner",
        "few, mean of 3 learners",
        "95 % bootstrap interval of the mean",
        "many, mean of 20 learners",
        "one",
    ]
    assert axes.get_ylabel() == "sigma"


def test_every_metric_gets_a_panel():
    values = {name: returns(3) * place for place, name in enumerate("abcd", start=1)}
    panels = metric_panels(FRAMES, values).axes
    assert [axes.get_title() for axes in panels if axes.get_visible()] == list("abcd")
    for axes, value in zip(panels, values.values(), strict=False):
        assert axes.get_lines()[0].get_ydata() == pytest.approx(value.mean(1))
