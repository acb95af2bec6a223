"""Metrics on disk: a CSV that outlives a killed process, and TensorBoard events for the eye."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor
from torchrl.record.loggers.tensorboard import TensorboardLogger

from torch_gprl.runs.errors import UserError


class MetricsWriter:
    """Writes one row per update and learner, and the same numbers as TensorBoard events.

    Each learner, and their mean, is a TensorBoard run of its own, so that one chart overlays all curves. The
    events' steps are environment steps.

    Args:
        csv_path: the table; its header is fixed by the first update.
        tensorboard: folder of the events.
    """

    def __init__(self, csv_path: Path, tensorboard: Path) -> None:
        self._file = csv_path.open("x", newline="", encoding="utf-8")
        self._table = csv.writer(self._file)
        self._tensorboard = tensorboard
        self._names: list[str] = []
        self._loggers: list[TensorboardLogger] = []

    def write(self, update: int, frames: int, metrics: Mapping[str, Tensor]) -> None:
        """Append one update.

        Args:
            update: number of the policy update.
            frames: environment steps per learner so far.
            metrics: name -> values `[learners]`.

        Raises:
            ValueError: if the names differ from those of the first update.
        """
        columns = {name: values.tolist() for name, values in metrics.items()}
        if not self._names:
            self._start(list(columns), learners=len(next(iter(columns.values()))))
        if list(columns) != self._names:
            raise ValueError(
                f"metrics must have the names of the first update, {self._names}; got {list(columns)}"
            )
        rows = zip(*columns.values(), strict=True)
        self._table.writerows((update, frames, learner, *row) for learner, row in enumerate(rows))
        self._file.flush()
        for name, values in columns.items():
            for logger, value in zip(self._loggers, [float(np.mean(values)), *values], strict=True):
                logger.log_scalar(name, value, step=frames)

    def close(self) -> None:
        """Close the table and the events."""
        self._file.close()
        for logger in self._loggers:
            logger.experiment.close()

    def _start(self, names: list[str], learners: int) -> None:
        self._names = names
        self._table.writerow(["update", "frames", "learner", *names])
        runs = ["mean", *(f"learner-{learner}" for learner in range(learners))]
        self._loggers = [TensorboardLogger(run, log_dir=str(self._tensorboard)) for run in runs]


def read_metrics(csv_path: Path) -> dict[str, Float[np.ndarray, "updates learners"]]:
    """Read back what `MetricsWriter` wrote.

    An update whose rows were cut off by a kill is left out.

    Args:
        csv_path: the table.

    Returns:
        name -> values `[updates, learners]`, float64; `update` and `frames` are among the names.

    Raises:
        UserError: if the file is missing or is no such table.
    """
    try:
        with csv_path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        learner_column = header.index("learner")
        whole = [row for row in rows if len(row) == len(header)]
        table = np.array(whole, dtype=np.float64).reshape(len(whole), len(header))
    except (OSError, ValueError) as error:
        raise UserError(f"{csv_path} is no table of metrics: {error}") from error
    learners = int(table[:, learner_column].max()) + 1 if len(table) else 0
    updates = len(table) // learners if learners else 0
    cube = table[: updates * learners].reshape(updates, learners, len(header))
    return {name: cube[..., column] for column, name in enumerate(header) if column != learner_column}
