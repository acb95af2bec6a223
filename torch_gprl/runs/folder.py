"""The folder that holds everything a run leaves behind.

    runs/<task>-<algorithm>-<date>-<time>/
      config.yaml        every option as resolved, versions, git commit, command line
      metrics.csv        one row per update and learner
      evaluation.csv     one row per learner and episode of the final evaluation
      tensorboard/       the same numbers as TensorBoard events, or what another logger writes
      checkpoints/       the last two states
      experience/        transitions in mapped files, if they were to be kept there
      figures/  videos/
      report.html        all of it on one page
      failure.txt        what ended the run, if something did

A run can be understood, drawn again and repeated from its folder alone.
"""

import csv
import dataclasses
import importlib.metadata
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import yaml
from jaxtyping import Float
from torch import Tensor

import torch_gprl
from torch_gprl.runs.errors import UserError

PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "gymnasium", "numpy")


class RunFolder:
    """A new run's folder with its standard places.

    Args:
        path: where the folder lies; made with its parents if absent.

    Raises:
        UserError: if the folder holds something already, is a file, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                raise UserError(f"run folder {path} is not empty; name another, or none for a new one")
            for place in (self.checkpoints, self.figures, self.videos):
                place.mkdir()
        except OSError as error:
            reason = error.strerror or str(error)
            raise UserError(f"cannot write run folder {path}: {reason}; name another folder") from error

    @classmethod
    def opened(cls, path: Path) -> "RunFolder":
        """The folder of a run that has been started.

        Raises:
            UserError: if it holds no run.
        """
        folder = cls.__new__(cls)
        folder.path = path
        if not folder.config.is_file():
            raise UserError(f"{path} holds no run: there is no {folder.config.name} in it")
        for place in (folder.checkpoints, folder.figures, folder.videos):
            place.mkdir(exist_ok=True)
        return folder

    @classmethod
    def named(cls, task: str, algorithm: str, root: Path = Path("runs")) -> "RunFolder":
        """Make `root/<task>-<algorithm>-<date>-<time>`, numbered if two runs start in the same second."""
        name = f"{task.replace('/', '-')}-{algorithm}-{datetime.now():%Y%m%d-%H%M%S}"
        candidate, number = root / name, 2
        while candidate.exists():
            candidate, number = root / f"{name}-{number}", number + 1
        return cls(candidate)

    @property
    def config(self) -> Path:
        """The file of the options."""
        return self.path / "config.yaml"

    @property
    def metrics(self) -> Path:
        """The file of the metrics."""
        return self.path / "metrics.csv"

    def curves(self, logger: str) -> Path:
        """The folder of what a logger writes."""
        return self.path / logger

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def experience(self) -> Path:
        """The folder of the experience that is kept in files."""
        return self.path / "experience"

    @property
    def figures(self) -> Path:
        """The folder of the figures."""
        return self.path / "figures"

    @property
    def videos(self) -> Path:
        """The folder of the videos."""
        return self.path / "videos"

    @property
    def failure(self) -> Path:
        """The file that tells what ended the run."""
        return self.path / "failure.txt"

    @property
    def report(self) -> Path:
        """The page that shows all of it."""
        return self.path / "report.html"

    def write_config(self, options: Mapping[str, object]) -> None:
        """Write `config.yaml`: the options, and what else it takes to repeat the run.

        Args:
            options: the resolved options by name; dataclasses and mappings may nest.

        Raises:
            UserError: if it cannot be written.
        """
        record = {
            **{name: _plain(value) for name, value in options.items()},
            "command": shlex.join(sys.argv),
            "started": datetime.now().astimezone().isoformat(timespec="seconds"),
            "git_commit": _git_commit(),
            "versions": _versions(),
        }
        text = yaml.safe_dump(record, sort_keys=False, allow_unicode=True)
        unfinished = self.config.with_suffix(".part")
        try:
            unfinished.write_text(text, encoding="utf-8")
            unfinished.replace(self.config)  # whoever finds a config finds a whole one
        except OSError as error:
            raise UserError(f"cannot write {self.config}: {error.strerror}; name another folder") from error

    def write_evaluation(self, returns: Float[Tensor, "learners episodes"]) -> None:
        """Write `evaluation.csv`: the return of every episode of the final evaluation."""
        with (self.path / "evaluation.csv").open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(["learner", "episode", "return"])
            for learner, episodes in enumerate(returns.tolist()):
                table.writerows((learner, episode, value) for episode, value in enumerate(episodes))


def _plain(value: object) -> object:
    """The value in YAML's own types; what has none becomes its text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _versions() -> dict[str, str]:
    """The versions of everything that can change a run's numbers."""
    versions = {"python": platform.python_version(), "torch_gprl": torch_gprl.__version__}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _git_commit() -> str | None:
    """The commit of this very source, with `-dirty` if it was changed; None if it is no checkout."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", here.name)  # else it is the commit of somebody else's repository
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None
