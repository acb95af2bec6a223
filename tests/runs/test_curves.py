"""Loggers: one of TorchRL's beside the table, and a clear word where its package is missing."""

import importlib.util

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torch_gprl.runs import MetricsWriter, UserError, check_logger, curves, read_metrics
from torch_gprl.runs.curves import Curves


def values(update: int) -> dict[str, torch.Tensor]:
    return {"return": torch.tensor([1.0, 3.0]) * update}


def events(directory) -> list[tuple[int, float]]:
    accumulator = EventAccumulator(str(directory))
    accumulator.Reload()
    return [(event.step, event.value) for event in accumulator.Scalars("return")]


def test_csv_means_the_table_alone(tmp_path):
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "csv", logger="csv")
    writer.write(1, 10, values(1))
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


@pytest.mark.parametrize("name", ["wandb", "mlflow", "trackio"])
def test_a_missing_package_is_named(name, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    with pytest.raises(UserError, match=f"logger '{name}' needs the package {name}: pip install {name}"):
        check_logger(name)
    check_logger("tensorboard")


def test_other_loggers_get_one_curve_for_each_learner_and_the_mean(tmp_path, monkeypatch):
    class Recorder:
        def __init__(self, kind: str, directory: str, name: str) -> None:
            self.made, self.points, self.closed = (kind, directory, name), [], False
            made.append(self)

        def log_scalar(self, name: str, value: float, step: int) -> None:
            self.points.append((name, value, step))

        def close(self) -> None:
            self.closed = True

    made: list[Recorder] = []
    monkeypatch.setattr(curves, "get_logger", Recorder)
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "my-run" / "wandb", logger="wandb")
    writer.write(1, 10, values(1))
    writer.close()
    (logger,) = made
    assert logger.made == ("wandb", str(tmp_path / "my-run" / "wandb"), "my-run")
    assert logger.points == [
        ("return/mean", 2.0, 10),
        ("return/learner-0", 1.0, 10),
        ("return/learner-1", 3.0, 10),
    ]
    assert logger.closed


@pytest.mark.parametrize("server", [None, "http://tracking"])
def test_mlflow_writes_to_its_server_or_to_a_database_of_the_run(server, tmp_path, monkeypatch):
    made = []

    def record(self, *given: str, **options: str | None) -> None:
        made.append((*given, options))

    monkeypatch.setattr(curves.MLFlowLogger, "__init__", record)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    if server is not None:
        monkeypatch.setenv("MLFLOW_TRACKING_URI", server)
    folder = tmp_path / "my-run" / "mlflow"
    Curves("mlflow", folder, learners=2)
    own = (f"sqlite:///{folder}/mlflow.db", {"artifact_location": folder.as_uri()})
    assert made == [("my-run", *(own if server is None else (server, {"artifact_location": None})))]
    assert folder.is_dir()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # MLflow's own
def test_mlflow_itself_keeps_every_point(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="needs mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "mlflow", logger="mlflow")
    for update in (1, 2):
        writer.write(update, 10 * update, values(update))
    writer.close()
    run = mlflow.last_active_run().info.run_id
    for name, expected in (("mean", [2.0, 4.0]), ("learner-1", [3.0, 6.0])):
        points = mlflow.MlflowClient().get_metric_history(run, f"return/{name}")
        assert [(point.step, point.value) for point in points] == list(zip((10, 20), expected, strict=True))
    mlflow.end_run()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # W&B's own
def test_wandb_itself_keeps_every_point(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    writer = MetricsWriter(tmp_path / "metrics.csv", tmp_path / "wandb", logger="wandb")
    for update in (1, 2):
        writer.write(update, 10 * update, values(update))
    assert wandb.run.summary["return/mean"] == 4.0
    assert wandb.run.summary["return/learner-1"] == 6.0
    writer.close()
    assert list(tmp_path.rglob("*.wandb"))


def test_a_resumed_run_replaces_what_came_after_its_checkpoint(tmp_path):
    """Updates 1 to 3, then again from 2 on with other numbers: table and events show each step once."""
    places = tmp_path / "metrics.csv", tmp_path / "tensorboard"
    writer = MetricsWriter(*places)
    for update in (1, 2, 3):
        writer.write(update, 10 * update, values(update))
    writer.close()
    writer = MetricsWriter(*places, after=1)
    for update in (2, 3):
        writer.write(update, 10 * update, values(100 * update))
    writer.close()
    expected = [1.0, 200.0, 300.0]
    assert read_metrics(places[0])["return"][:, 0].tolist() == expected
    assert events(places[1] / "learner-0") == [(10, 1.0), (20, 200.0), (30, 300.0)]


@pytest.mark.parametrize(
    "rest", ["2,20,0,5.0", "2,20,0,5.0\r\n", "2,20,0,5.0\r\n2,20,1,7.", "3,30,0,1.0\r\n"]
)
def test_rows_after_the_checkpoint_are_cut_off_whatever_was_left_of_them(tmp_path, rest):
    path = tmp_path / "metrics.csv"
    kept = "update,frames,learner,return\r\n1,10,0,1.0\r\n1,10,1,2.0\r\n"
    path.write_text(kept + rest, encoding="utf-8", newline="")
    MetricsWriter(path, tmp_path / "curves", after=1).close()
    assert path.read_bytes().decode() == kept


def test_a_run_without_a_checkpoint_starts_its_table_anew(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("update,frames,learner,return\r\n1,10,0,1.0\r\n", encoding="utf-8", newline="")
    writer = MetricsWriter(path, tmp_path / "curves", "csv", after=0)
    writer.write(1, 10, values(1))
    writer.close()
    assert read_metrics(path)["return"].tolist() == [[1.0, 3.0]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is missing: the metrics up to update 2 are lost"),
        ("nonsense\r\n", "is no table of metrics"),
        (
            "update,frames,learner,return\r\n1,10,0,1.0\r\n",
            "ends at update 1, before the checkpoint of update 2",
        ),
    ],
)
def test_a_table_that_does_not_reach_the_checkpoint_is_refused(tmp_path, content, message):
    path = tmp_path / "metrics.csv"
    if content is not None:
        path.write_text(content, encoding="utf-8", newline="")
    with pytest.raises(UserError, match=message):
        MetricsWriter(path, tmp_path / "curves", after=2)
