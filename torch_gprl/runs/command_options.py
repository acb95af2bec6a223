"""The options of a run, and of the commands that look at finished or interrupted ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from torch_gprl.runs.curves import LoggerName

EVALUATION_SEED = 1_000_000  # the starts of all evaluations, whatever the run's own seed
CollectorName = Literal["multi-sync", "multi-async", "ray"]
ReplayStorage = Literal["memory", "disk"]


@dataclass(frozen=True)
class RunOptions:
    """What to run, where, and where to keep it."""

    task: str = "pendulum-swingup"  # id of the task; a wrong one lists all
    learners: int = 5  # independent learners, trained side by side; the learning curve shows their spread
    num_envs: int = 5  # environments of each learner, stepped together
    seed: int = 0  # of all random numbers; the evaluation has a seed of its own
    threads: int = 1  # processor threads of torch and of the simulator
    workers: int = 0  # processes that share the environments and collect side by side; 0 collects right here
    collector: CollectorName = "multi-sync"  # of the workers: in step, each for itself, or on Ray's machines
    replay_storage: ReplayStorage = "memory"  # of experience: memory, or mapped files in the run's folder
    device: str = "cpu"  # where policy and critic live: cpu, cuda, cuda:1, ...
    out: Path | None = None  # run folder, new or empty; unless given runs/<task>-<algorithm>-<date>-<time>
    evaluation_episodes: int = 20  # episodes of the final evaluation, for each learner
    checkpoint_interval: float = 60.0  # s between checkpoints; changes no result
    logger: LoggerName = "tensorboard"  # of the curves, beside metrics.csv; csv writes that table alone

    def __post_init__(self) -> None:
        """Refuse what no run can start with."""
        for name in ("learners", "num_envs", "threads", "evaluation_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.workers < 0 or (self.workers and self.num_envs % self.workers):
            raise ValueError(f"workers must divide num_envs, {self.num_envs}, or be 0, but is {self.workers}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, but is {self.seed}")
        if not self.checkpoint_interval >= 0:
            raise ValueError(f"checkpoint_interval must not be negative, but is {self.checkpoint_interval}")
        if self.collector != "multi-sync" and not self.workers:
            raise ValueError(f"collector {self.collector} needs workers: say how many by --workers")


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
