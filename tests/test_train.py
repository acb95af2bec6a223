"""The command line: what a run leaves, how it stops, and what it says to mistakes."""

import csv
import dataclasses
import importlib.util
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import pytest
import yaml

import envs
import train
from torch_gprl.runs import Checkpoints

ROOT = Path(__file__).parents[1]
TINY = ["--learners", "2", "--num-envs", "2", "--budget", "20", "--evaluation-episodes", "2"]


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """Two updates of two learners in a process of their own: exit code, output, run folder."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    short_film = "import sys, train; train.LONGEST_FILM = 20; sys.exit(train.main(sys.argv[1:]))"
    command = [sys.executable, "-c", short_film, "policy-gradient", *TINY]
    command += ["--total-frames", "800", "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT)
    return SimpleNamespace(code=done.returncode, output=done.stdout, errors=done.stderr, folder=folder)


def test_a_run_succeeds_and_says_what_it_reached_and_where_it_lies(tiny_run):
    assert tiny_run.code == 0, tiny_run.errors
    first, result, last = tiny_run.output.splitlines()
    assert first == f"policy-gradient on pendulum-swingup: 2 learners, results in {tiny_run.folder}"
    assert result.startswith("final return ")
    assert "over 2 learners, 2 episodes each" in result
    assert last == f"everything is in {tiny_run.folder}"


def test_without_a_terminal_progress_is_a_plain_line(tiny_run):
    assert "100%  steps 800/800  return " in tiny_run.errors
    assert "Traceback" not in tiny_run.errors


def test_the_config_is_what_was_asked_for(tiny_run):
    config = yaml.safe_load((tiny_run.folder / "config.yaml").read_text(encoding="utf-8"))
    assert config["run"]["learners"] == 2
    assert config["config"]["budget"] == 20
    assert config["config"].keys() == {field.name for field in dataclasses.fields(train.PolicyGradientConfig)}


def test_the_metrics_have_a_row_per_update_and_learner(tiny_run):
    with (tiny_run.folder / "metrics.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["update"], row["learner"], row["frames"]) for row in rows] == [
        ("1", "0", "400"),
        ("1", "1", "400"),
        ("2", "0", "800"),
        ("2", "1", "800"),
    ]


def test_the_result_is_the_mean_of_the_evaluation(tiny_run):
    with (tiny_run.folder / "evaluation.csv").open(encoding="utf-8") as file:
        returns = [float(row["return"]) for row in csv.DictReader(file)]
    assert len(returns) == 4
    assert f"final return {sum(returns) / 4:.2f}," in tiny_run.output


def test_there_are_figures_a_film_a_checkpoint_and_events(tiny_run):
    for name in ("learning_curve.png", "value_surface.png", "foresight.png", "metrics.png"):
        assert matplotlib.image.imread(tiny_run.folder / "figures" / name).std() > 0.05
    assert (tiny_run.folder / "videos" / "best_learner.mp4").stat().st_size > 1000
    assert sorted(path.name for path in (tiny_run.folder / "checkpoints").iterdir()) == [
        "checkpoint-000000000001.torchrl",
        "checkpoint-000000000002.torchrl",
    ]
    assert {path.name for path in (tiny_run.folder / "tensorboard").iterdir()} == {
        "mean",
        "learner-0",
        "learner-1",
    }


def test_the_checkpoint_holds_what_was_learned(tiny_run):
    options = train.parse(["--learners", "2", "--num-envs", "2", "--budget", "20"])[1]
    learner = train.PolicyGradient(train.make_env(options.run, 2, seed=5), options.algorithm, seed=5)
    checkpoints = Checkpoints(tiny_run.folder / "checkpoints", learner=learner)
    checkpoints.load(checkpoints.at(2))
    assert (learner.updates, learner.frames) == (2, 800)


class Process:
    """The command line in a process of its own; its film is short."""

    PROGRAM = "import sys, train; train.LONGEST_FILM = 2; sys.exit(train.main(sys.argv[1:]))"

    def __init__(self, arguments: list[str], folder: Path) -> None:
        self.output, self.errors = folder / "output", folder / "errors"
        command = [sys.executable, "-c", self.PROGRAM, *arguments]
        with self.output.open("w") as output, self.errors.open("w") as errors:
            self._process = subprocess.Popen(
                command, stdout=output, stderr=errors, cwd=Path(train.__file__).parent
            )

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def wait_for(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 120
        while not condition():
            assert self._process.poll() is None, self.errors.read_text(encoding="utf-8")
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def end(self) -> tuple[int, str, str]:
        """Exit code, output, errors."""
        code = self._process.wait()
        return code, self.output.read_text(encoding="utf-8"), self.errors.read_text(encoding="utf-8")


def an_endless_run(folder: Path) -> Process:
    """A run that has made its first update and would go on for days."""
    run = Process([*TINY, "--total-frames", "1000000000", "--out", str(folder / "run")], folder)
    metrics = folder / "run" / "metrics.csv"
    run.wait_for(lambda: metrics.exists() and metrics.read_text(encoding="utf-8").count("\n") > 2)
    return run


def test_ctrl_c_keeps_what_was_learned(tmp_path):
    run = an_endless_run(tmp_path)
    run.interrupt()
    code, output, errors = run.end()
    assert code == 0, errors
    assert "finishing this update" in errors
    assert "stopped after" in output
    assert "final return" in output
    assert (tmp_path / "run" / "figures" / "learning_curve.png").exists()
    assert (tmp_path / "run" / "report.html").exists()


def test_ctrl_c_twice_aborts(tmp_path):
    run = an_endless_run(tmp_path)
    run.interrupt()
    run.wait_for(lambda: "finishing this update" in run.errors.read_text(encoding="utf-8"))
    run.interrupt()
    code, output, errors = run.end()
    assert code == 130
    assert errors.splitlines()[-1] == "train.py: aborted"
    assert "Traceback" not in errors
    assert "final return" not in output


# ---------------------------------------------------------------- commands on a finished run


def test_evaluate_finds_again_what_the_run_found(tiny_run, capsys):
    code = train.main(["evaluate", str(tiny_run.folder), "--episodes", "2"])
    *learners, result = capsys.readouterr().out.splitlines()
    assert code == 0
    assert [line.split(":")[0] for line in learners] == ["learner 0", "learner 1"]
    assert result == f"after update 2: {tiny_run.output.splitlines()[1]}"


def test_evaluate_can_look_at_an_earlier_checkpoint(tiny_run, capsys):
    train.main(["evaluate", str(tiny_run.folder), "--episodes", "1", "--checkpoint", "1"])
    assert capsys.readouterr().out.splitlines()[-1].startswith("after update 1: final return ")


def test_render_films_the_learner_asked_for(tiny_run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(train, "LONGEST_FILM", 2)
    film = tmp_path / "film.mp4"
    assert train.main(["render", str(tiny_run.folder), "--learner", "1", "--out", str(film)]) == 0
    assert film.stat().st_size > 500
    assert capsys.readouterr().out.strip() == str(film)


def test_plot_compares_runs(tiny_run, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(train, "compare_curves", lambda curves, label: drawn.append((curves, label)))
    monkeypatch.setattr(train, "save_figure", lambda figure, path: drawn.append(path))
    copy = shutil.copytree(tiny_run.folder, tmp_path / "again" / tiny_run.folder.name)
    picture = str(tmp_path / "both.png")
    train.main(["plot", str(tiny_run.folder), str(copy), "--metric", "sigma", "--out", picture])
    (curves, label), path = drawn
    assert list(curves) == [str(tiny_run.folder), str(copy)]  # the names alone would be the same
    assert [list(frames) for frames, _ in curves.values()] == [[400, 800]] * 2
    assert (label, path) == ("sigma", Path(picture))


def test_tasks_are_listed_with_their_pictures(capsys):
    assert train.main(["tasks"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(envs.ALL)
    assert Path(last.removeprefix("pictures: ")).exists()


def test_a_runs_config_repeats_its_options(tiny_run):
    _, again = train.parse(["--config", str(tiny_run.folder / "config.yaml"), "--seed", "3"])
    _, asked = train.parse(["policy-gradient", *TINY, "--total-frames", "800", "--out", str(tiny_run.folder)])
    assert again == dataclasses.replace(asked, run=dataclasses.replace(asked.run, seed=3))


@pytest.mark.parametrize("name", train.ALGORITHMS)
def test_presets_are_options_of_tasks_that_exist(name):
    for task, preset in train.ALGORITHMS[name].presets.items():
        assert task in envs.ALL
        options = train.parse([name, "--task", task])[1]
        for option, value in preset.items():
            assert value in (getattr(options.algorithm, option, None), getattr(options.run, option, None))


RUN_MISTAKES = {
    "evaluate {empty}": r"empty holds no run: there is no config\.yaml in it",
    "--resume nowhere": r"nowhere holds no run",
    "--resume {run} --checkpoint 7": r"there is no checkpoint 7 in .*; there are: 1, 2",
    "render {run} --learner 2": r"learner must lie between 0 and 1, but is 2",
    "plot {run} --metric retrun": r"has no metric 'retrun'; choose one of update, frames, ",
    "plot": r"plot needs the folder of a run",
    "--logger wandb": r"logger 'wandb' needs the package wandb",
}


@pytest.mark.parametrize("arguments", RUN_MISTAKES)
def test_a_mistake_about_a_run_gets_one_line_and_exit_code_2(
    arguments, tiny_run, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    (tmp_path / "empty").mkdir()
    code = train.main(arguments.format(run=tiny_run.folder, empty=tmp_path / "empty").split())
    (line,) = capsys.readouterr().err.splitlines()
    assert code == 2
    assert re.search(RUN_MISTAKES[arguments], line)
