"""The command line: what a run leaves, how it stops, and what it says to mistakes."""

import csv
import dataclasses
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import pytest
import yaml

import train
from torch_gprl.runs import Checkpoints

ROOT = Path(__file__).parents[1]
TINY = ["--learners", "2", "--num-envs", "2", "--budget", "20", "--evaluation-episodes", "2"]


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "train.py"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """Two updates of two learners, as a user starts them: exit code, output, run folder."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    process = start("policy-gradient", *TINY, "--total-frames", "800", "--out", str(folder))
    output, errors = process.communicate(timeout=300)
    return SimpleNamespace(code=process.returncode, output=output, errors=errors, folder=folder)


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


def wait_for(condition, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def an_endless_run(folder: Path) -> subprocess.Popen[str]:
    """A run that has made its first update and would go on for days."""
    process = start(*TINY, "--total-frames", "1000000000", "--out", str(folder))
    metrics = folder / "metrics.csv"
    wait_for(lambda: metrics.exists() and metrics.read_text(encoding="utf-8").count("\n") > 2, process)
    return process


def test_ctrl_c_keeps_what_was_learned(tmp_path):
    process = an_endless_run(tmp_path / "run")
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "finishing this update" in errors
    assert "stopped after" in output
    assert "final return" in output
    assert (tmp_path / "run" / "figures" / "learning_curve.png").exists()
    assert (tmp_path / "run" / "report.html").exists()


def test_ctrl_c_twice_aborts(tmp_path):
    process = an_endless_run(tmp_path / "run")
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    while "finishing this update" not in (line := process.stderr.readline()):
        assert line or process.poll() is None
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert errors.splitlines()[-1] == "train.py: aborted"
    assert "Traceback" not in errors
    assert "final return" not in output


MISTAKES = {
    "--task pendlum": r"unknown task 'pendlum'.*pendulum-swingup",
    "reinforse": r"unknown algorithm 'reinforse'; choose one of policy-gradient",
    "--lernars 3": r"Unrecognized options: --lernars.*Perhaps you meant: --learners",
    "--learners three": r"--learners.*'three'",
    "--learners 0": r"learners must be at least 1, not 0",
    "--seed -1": r"seed must not be negative, but is -1",
    "--budget": r"Missing value for argument '--budget'",
    "--device abacus": r"device 'abacus' cannot be used: .*; --device cpu always can",
    "--out {folder}": r"run folder .* is not empty; name another",
    "--out {folder}/file/run": r"cannot write run folder .*; name another folder",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_gets_one_line_and_exit_code_2(arguments, tmp_path, capsys):
    (tmp_path / "file").touch()
    code = train.main(arguments.format(folder=tmp_path).split())
    output, errors = capsys.readouterr()
    assert code == 2
    assert output == ""
    (line,) = errors.splitlines()
    assert line.startswith("train.py: ")
    assert re.search(MISTAKES[arguments], line)


def test_a_mistake_on_a_coloured_terminal_is_plain(capsys, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    train.main(["--learners", "0"])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert "learners must be at least 1, not 0" in line


def test_a_mistake_ends_the_process_with_code_2():
    process = start("--learners", "0")
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert output == ""
    assert len(errors.splitlines()) == 1


@pytest.mark.parametrize("name", train.ALGORITHMS)
def test_help_explains_every_option(name, capsys):
    with pytest.raises(SystemExit) as end:
        train.main([name, "--help"])
    assert end.value.code == 0
    shown = " ".join(re.sub(r"[│|]", " ", capsys.readouterr().out).split())
    options = train.ALGORITHMS[name].options()
    for field in [*dataclasses.fields(options.run), *dataclasses.fields(options.algorithm)]:
        flag = f"--{field.name.replace('_', '-')}"
        assert flag in shown
        explanation = shown.split(flag, 1)[1].split("(default", 1)[0]
        assert len(explanation.split()) > 3, f"{flag} is not explained"


def test_no_argument_means_policy_gradient_on_the_swing_up():
    name, options = train.parse([])
    assert name == "policy-gradient"
    assert options == train.PolicyGradientOptions()
    assert options.run.task == "pendulum-swingup"


def test_options_reach_run_and_algorithm():
    _, options = train.parse(["policy-gradient", "--learners", "3", "--budget", "17", "--out", "there"])
    assert (options.run.learners, options.algorithm.budget, options.run.out) == (3, 17, Path("there"))
