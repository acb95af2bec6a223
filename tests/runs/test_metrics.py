"""Metrics: what is written comes back, also after a kill in the middle of a row."""

import math

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torch_gprl.runs import MetricsWriter, UserError, read_metrics


def an_update(frames: int) -> dict[str, torch.Tensor]:
    return {
        "return": torch.tensor([1.0, 2.0, 6.0], dtype=torch.float64) * frames / 7,
        "basis_size": torch.full((3,), 50),
    }


@pytest.fixture
def written(tmp_path):
    """A table of two updates of three learners, not closed: as a killed process leaves it."""
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "tensorboard")
    writer.write(1, 100, an_update(100))
    writer.write(2, 200, an_update(200))
    yield tmp_path
    writer.close()


def test_every_update_is_on_disk_at_once_and_exact(written):
    metrics = read_metrics(written / "metrics.csv")
    assert metrics.keys() == {"update", "frames", "return", "basis_size"}
    assert metrics["update"].tolist() == [[1] * 3, [2] * 3]
    assert metrics["return"].tolist() == [
        an_update(100)["return"].tolist(),
        an_update(200)["return"].tolist(),
    ]


def test_a_row_is_an_update_and_a_learner(written):
    lines = (written / "metrics.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "update,frames,learner,return,basis_size"
    assert [line.rsplit(",", 2)[0] for line in lines[1:]] == [
        "1,100,0",
        "1,100,1",
        "1,100,2",
        "2,200,0",
        "2,200,1",
        "2,200,2",
    ]


@pytest.mark.parametrize("lost", [1, 12, 40])
def test_an_update_that_was_cut_off_is_left_out(written, lost):
    path = written / "metrics.csv"
    path.write_bytes(path.read_bytes()[:-lost].rsplit(b",", 1)[0])
    assert read_metrics(path)["update"].tolist() == [[1] * 3]


def test_tensorboard_shows_the_mean_and_each_learner(tmp_path):
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "tensorboard")
    writer.write(1, 70, an_update(70))
    writer.close()
    values = {}
    for run in ("mean", "learner-0", "learner-1", "learner-2"):
        events = EventAccumulator(str(tmp_path / "tensorboard" / run))
        events.Reload()
        (event,) = events.Scalars("return")
        assert event.step == 70
        values[run] = event.value
    assert values == pytest.approx({"mean": 30.0, "learner-0": 10.0, "learner-1": 20.0, "learner-2": 60.0})


def test_a_metric_that_comes_late_is_refused(written):
    writer = MetricsWriter(written / "other.csv", written / "other")
    writer.write(1, 100, an_update(100))
    with pytest.raises(ValueError, match="names of the first update"):
        writer.write(2, 200, {**an_update(200), "surprise": torch.zeros(3)})
    writer.close()


def test_not_a_number_survives(tmp_path):
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "tensorboard")
    writer.write(1, 5, {"return": torch.tensor([math.nan])})
    writer.close()
    assert math.isnan(read_metrics(tmp_path / "metrics.csv")["return"].item())


@pytest.mark.parametrize("content", [None, "", "a,b\n1,2\n", "update,learner\nx,y\n"])
def test_another_file_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.csv").write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=r"metrics\.csv is no table of metrics"):
        read_metrics(tmp_path / "metrics.csv")
