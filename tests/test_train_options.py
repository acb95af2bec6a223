"""The command line: what the options are, and what it says to mistakes in them."""

import dataclasses
import re
import sys
from pathlib import Path

import pytest

import train

MISTAKES = {
    "--task pendlum": r"unknown task 'pendlum'.*pendulum-swingup",
    "reinforse": r"unknown algorithm 'reinforse'; choose one of policy-gradient",
    "--lernars 3": r"Unrecognized options: --lernars.*Perhaps you meant: --learners",
    "--learners three": r"--learners.*'three'",
    "--learners 0": r"learners must be at least 1, not 0",
    "--seed -1": r"seed must not be negative, but is -1",
    "--budget": r"Missing value for argument '--budget'",
    "--device abacus": r"device 'abacus' cannot be used: .*; --device cpu always can",
    "--replay-storage disk": r"uses each rollout once and keeps none: leave --replay-storage out",
    "--workers 2 --num-envs 3": r"workers must divide num_envs, 3, or be 0, but is 2",
    "dynamic-programming --workers 1": r"this learner's plan does not travel to other processes",
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


def fields_of(kind: type) -> list[dataclasses.Field]:
    """The fields that become options, those of dataclasses within included."""
    found = []
    for field in dataclasses.fields(kind):
        found += fields_of(field.type) if dataclasses.is_dataclass(field.type) else [field]
    return found


@pytest.mark.parametrize("name", train.ALGORITHMS)
def test_help_explains_every_option(name, capsys):
    with pytest.raises(SystemExit) as end:
        train.main([name, "--help"])
    assert end.value.code == 0
    shown = " ".join(re.sub(r"[│|]", " ", capsys.readouterr().out).split())
    options = train.ALGORITHMS[name].options()
    for field in fields_of(type(options.run)) + fields_of(type(options.algorithm)):
        flag = f"--{field.name.replace('_', '-')}"
        assert flag in shown
        explanation = shown.split(flag, 1)[1].split("(default", 1)[0]
        assert len(explanation.split()) > 2, f"{flag} is not explained"


def test_no_argument_means_policy_gradient_on_the_swing_up():
    name, options = train.parse([])
    assert name == "policy-gradient"
    assert options.algorithm == train.PolicyGradientConfig()
    assert options.run.task == "pendulum-swingup"


def test_options_reach_run_and_algorithm():
    _, options = train.parse(["policy-gradient", "--learners", "3", "--budget", "17", "--out", "there"])
    assert (options.run.learners, options.algorithm.budget, options.run.out) == (3, 17, Path("there"))
