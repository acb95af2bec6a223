"""The metrics for the eye: TensorBoard's events, or another of TorchRL's loggers."""

import importlib.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from torchrl.record.loggers import get_logger
from torchrl.record.loggers.mlflow import MLFlowLogger

from torch_gprl.runs.errors import UserError

LoggerName = Literal["csv", "tensorboard", "wandb", "mlflow", "trackio"]
OPTIONAL = ("wandb", "mlflow", "trackio")  # packages of the same names that a user may lack


def check_logger(name: LoggerName) -> None:
    """Refuse a logger whose package is missing.

    Raises:
        UserError: naming the package.
    """
    if name in OPTIONAL and importlib.util.find_spec(name) is None:
        raise UserError(
            f"logger '{name}' needs the package {name}: pip install {name}, or choose --logger tensorboard"
        )


class Curves:
    """Draws the metrics of each learner, and their mean, by one of TorchRL's loggers.

    In TensorBoard each learner and the mean are runs of their own, so that one chart overlays all; elsewhere
    they are curves named `<metric>/mean`, `<metric>/learner-0`, ...

    Args:
        logger: which one; "csv" draws nothing, as the table of the metrics holds all.
        directory: folder of what the logger writes.
        learners: number of curves beside the mean.
        after: environment steps behind which older events are void, when a run is resumed.
    """

    def __init__(self, logger: LoggerName, directory: Path, learners: int, after: int | None = None) -> None:
        self._labels = ["mean", *(f"learner-{learner}" for learner in range(learners))]
        self._loggers: list[Any] = []
        if logger == "tensorboard":
            self._loggers = [get_logger(logger, str(directory), label) for label in self._labels]
        elif logger == "mlflow":
            self._loggers = [_mlflow_logger(directory)]
        elif logger != "csv":
            self._loggers = [get_logger(logger, str(directory), directory.parent.name)]
        if logger == "tensorboard" and after is not None:
            start = Event(step=after + 1, session_log=SessionLog(status=SessionLog.START))
            for one in self._loggers:
                one.experiment.file_writer.add_event(start)  # TensorBoard forgets later events of this run

    def write(self, frames: int, columns: Mapping[str, Sequence[float]]) -> None:
        """Add a point to every curve.

        Args:
            frames: environment steps per learner so far.
            columns: metric -> values of the learners.
        """
        for name, values in columns.items():
            points = zip(self._labels, [float(np.mean(values)), *values], strict=True)
            for place, (label, value) in enumerate(points):
                if len(self._loggers) == 1:
                    self._loggers[0].log_scalar(f"{name}/{label}", value, step=frames)
                elif self._loggers:
                    self._loggers[place].log_scalar(name, value, step=frames)

    def close(self) -> None:
        """Write out what is pending."""
        for logger in self._loggers:
            logger.close()


def _mlflow_logger(directory: Path) -> MLFlowLogger:
    """The server of MLFLOW_TRACKING_URI, or a database of the run: MLflow no longer writes plain files."""
    directory.mkdir(parents=True, exist_ok=True)
    own = f"sqlite:///{directory.absolute() / 'mlflow.db'}"
    server = os.environ.get("MLFLOW_TRACKING_URI", own)
    place = directory.absolute().as_uri() if server == own else None
    return MLFlowLogger(directory.parent.name, server, artifact_location=place)
