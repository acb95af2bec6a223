"""Metrics on disk: a CSV that outlives a killed process, and curves for the eye."""

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torch_gprl.runs.curves import Curves, LoggerName
from torch_gprl.runs.errors import UserError

KEYS = ("update", "frames", "learner")  # the columns before the metrics


class MetricsWriter:
    """Writes one row per update and learner, and the same numbers as curves over environment steps.

    Args:
        csv_path: the table; its header is fixed by the first update.
        curves: folder of what the logger writes.
        logger: one of TorchRL's loggers, or "csv" for the table alone.
        after: the update after which a resumed run goes on: later rows are cut off. None starts a new table.

    Raises:
        UserError: if the table to go on with lacks that update.
    """

    def __init__(
        self, csv_path: Path, curves: Path, logger: LoggerName = "tensorboard", after: int | None = None
    ) -> None:
        self._names: list[str] = []
        self._directory, self._after = curves, after
        self._logger: LoggerName = logger
        if after is not None and csv_path.exists():
            self._names = cut(csv_path, after)
        elif after:
            raise UserError(f"{csv_path} is missing: the metrics up to update {after} are lost")
        mode = "a" if self._names else "x" if after is None else "w"
        self._file = csv_path.open(mode, newline="", encoding="utf-8")
        self._table = csv.writer(self._file)
        self._curves: Curves | None = None

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
        learners = len(next(iter(columns.values())))
        if not self._names:
            self._names = list(columns)
            self._table.writerow([*KEYS, *self._names])
        if list(columns) != self._names:
            raise ValueError(
                f"metrics must have the names of the first update, {self._names}; got {list(columns)}"
            )
        rows = zip(*columns.values(), strict=True)
        self._table.writerows((update, frames, learner, *row) for learner, row in enumerate(rows))
        self._file.flush()
        if self._curves is None:
            resumed = None if self._after is None else frames - 1
            self._curves = Curves(self._logger, self._directory, learners, resumed)
        self._curves.write(frames, columns)

    def sync(self) -> None:
        """See that what was written is on the disk, whatever happens to the machine."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the table and the curves."""
        self._file.close()
        if self._curves is not None:
            self._curves.close()


def cut(csv_path: Path, after: int) -> list[str]:
    """Cut all rows after an update off a table; returns the names of the metrics.

    Raises:
        UserError: if the file is no table of metrics or does not reach the update.
    """
    with csv_path.open("r+b") as file:
        header = file.readline().decode(errors="replace").strip().split(",")
        if after == 0:
            file.truncate(0)
            return []
        if tuple(header[: len(KEYS)]) != KEYS:
            raise UserError(f"{csv_path} is no table of metrics")
        end, last = _end_of(file, after)
        if last != after:
            raise UserError(
                f"{csv_path} ends at update {last}, before the checkpoint of update {after}; resume from an "
                "earlier one by --checkpoint"
            )
        file.truncate(end)
    return header[len(KEYS) :]


def _end_of(file: BinaryIO, update: int) -> tuple[int, int]:
    """Where the rows up to an update end, and the last update among them."""
    end, last = file.tell(), 0
    for row in file:
        number = row.split(b",", 1)[0]
        if not row.endswith(b"\n") or not number.isdigit() or int(number) > update:
            break
        end, last = end + len(row), int(number)
    return end, last


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
