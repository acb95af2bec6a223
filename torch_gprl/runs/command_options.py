"""The options of the commands that look at finished or interrupted runs."""

from dataclasses import dataclass
from pathlib import Path

import tyro

EVALUATION_SEED = 1_000_000  # the starts of all evaluations, whatever the run's own seed


@dataclass(frozen=True)
class ARun:
    """A run as it stood at an update."""

    folder: tyro.conf.Positional[Path]  # the run's folder
    checkpoint: int | None = None  # update that is meant; the latest kept unless given


@dataclass(frozen=True)
class ResumeOptions(ARun):
    """Go on where a run was stopped or killed, as if it had not been."""


@dataclass(frozen=True)
class EvaluateOptions(ARun):
    """Returns of a run's policies without exploration."""

    episodes: int = 100  # for each learner
    seed: int = EVALUATION_SEED  # of the episodes' starts


@dataclass(frozen=True)
class RenderOptions(ARun):
    """Film one learner's policy, without exploration, through an episode."""

    learner: int | None = None  # whom to show; the best in 20 episodes unless given
    seed: int = EVALUATION_SEED  # of the episode's start
    out: Path | None = None  # the film, ending in .mp4; unless given in the run's folder


@dataclass(frozen=True)
class ReportOptions(ARun):
    """Evaluate and draw a run again, and write its report.html."""


@dataclass(frozen=True)
class PlotOptions:
    """Learning curves of runs in one picture, each with the band of its learners."""

    folders: tyro.conf.Positional[tuple[Path, ...]]  # the runs' folders
    metric: str = "return"  # column of metrics.csv
    out: Path = Path("comparison.png")  # the picture: .png, .pdf or .svg


@dataclass(frozen=True)
class TasksOptions:
    """List the tasks."""
