"""The command line's parts: settings from files, presets, and one line for every mistake."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import tyro
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torch_gprl.runs import Algorithm, CommandLine, RunFolder, UserError


@dataclass(frozen=True)
class Run:
    """Where."""

    task: str = "walk"  # what to learn
    seed: int = 0  # of random numbers
    out: Path | None = None  # where results go


@dataclass(frozen=True)
class Noise:
    """How much of it."""

    least: float = 0.1  # standard deviation
    most: float = 1.0  # standard deviation


@dataclass(frozen=True)
class Numbers:
    """How."""

    budget: int = 100  # basis vectors
    noise: float = 0.1  # variance
    age_form: Literal["exponential", "logit"] = "exponential"  # of the age
    in_sample: bool = False  # whether to cheat
    exploration: Noise = field(default_factory=lambda: Noise(0.2))


@dataclass(frozen=True)
class Options:
    """Learn."""

    run: tyro.conf.OmitArgPrefixes[Run] = field(default_factory=Run)
    algorithm: tyro.conf.OmitArgPrefixes[Numbers] = field(default_factory=Numbers)


@dataclass(frozen=True)
class Resume:
    """Go on."""

    folder: tyro.conf.Positional[Path]  # of the run
    checkpoint: int | None = None  # update


PRESETS = {"run": {"budget": 7, "noise": 0.5}}
LINE = CommandLine(
    "everything",
    {"first": Algorithm(Options, object, PRESETS), "second": Algorithm(Options, object)},
    {"resume": Resume},
)


def a_file(tmp_path: Path, text: str) -> str:
    path = tmp_path / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_the_first_algorithm_is_meant_where_none_is_named():
    assert LINE.parse([]) == ("first", Options())
    assert LINE.parse(["second", "--seed", "3"]) == ("second", Options(Run(seed=3)))


def test_a_preset_gives_way_to_what_is_asked_for():
    assert LINE.parse(["--task", "run"])[1].algorithm == Numbers(budget=7, noise=0.5)
    assert LINE.parse(["--task", "run", "--budget", "8"])[1].algorithm == Numbers(budget=8, noise=0.5)
    assert LINE.parse(["second", "--task", "run"])[1].algorithm == Numbers()


def test_help_shows_the_presets(capsys):
    with pytest.raises(SystemExit):
        LINE.parse(["first", "--help"])
    assert "run: --budget=7 --noise=0.5" in " ".join(capsys.readouterr().out.replace("│", " ").split())


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_alone_shows_everything(flag, capsys):
    with pytest.raises(SystemExit, match="0"):
        LINE.parse([flag])
    assert capsys.readouterr().out == "everything\n"


@pytest.mark.parametrize(
    "text",
    [
        "algorithm: second\nrun: {seed: 4, out: }\nconfig: {noise: 1e-3, in_sample: true}\nversions: {a: b}",
        "algorithm: second\nseed: 4\nnoise: 0.001\nin_sample: true",
    ],
)
def test_a_file_is_read_with_or_without_sections(tmp_path, text):
    name, options = LINE.parse(["--config", a_file(tmp_path, text)])
    assert (name, options) == ("second", Options(Run(seed=4), Numbers(noise=1e-3, in_sample=True)))


def test_what_a_run_writes_of_nested_options_can_be_read_again(tmp_path):
    folder = RunFolder(tmp_path / "run")
    options = Options(algorithm=Numbers(exploration=Noise(0.3, 4.0)))
    folder.write_config({"algorithm": "second", "run": options.run, "config": options.algorithm})
    assert LINE.parse(["--config", str(folder.config)]) == ("second", options)
    assert LINE.parse(["second", "--least", "0.3", "--most", "4"]) == ("second", options)


def test_the_command_line_wins_over_the_file_and_the_file_over_presets(tmp_path):
    path = a_file(tmp_path, "task: run\nbudget: 9\nseed: -1")
    options = LINE.parse(["--seed", "5", f"--config={path}"])[1]
    assert options == Options(Run(task="run", seed=5), Numbers(budget=9, noise=0.5))


def test_resume_is_a_command_and_an_option():
    expected = ("resume", Resume(Path("there"), 7))
    assert LINE.parse(["resume", "there", "--checkpoint", "7"]) == expected
    assert LINE.parse(["--resume", "there", "--checkpoint", "7"]) == expected
    assert LINE.parse(["first", "--checkpoint=7", "--resume=there"]) == expected


MISTAKES = {
    "budgett: 3": r"unknown setting 'budgett'; did you mean 'budget'\? Or choose one of task, seed,",
    "zzz: 3": r"unknown setting 'zzz'; choose one of task, seed",
    "budget: many": r"settings.yaml: Error parsing --budget: .*'many'",
    "budget: true": r"settings.yaml: Error parsing --budget: .*'True'",
    "budget: [1, 2]": r"budget must be a single value, not \[1, 2\]",
    "exploration: 1": r"exploration must hold names and values, not 1",
    "exploration: {leest: 1}": r"unknown setting 'leest'; did you mean 'least'",
    "in_sample: 1": r"in_sample must be true or false, not 1",
    "age_form: linear": r"invalid choice 'linear' for argument '--age-form'. Expected one of",
    "algorithm: thrid": r"unknown algorithm 'thrid'; .*one of first, second",
    "algorithm: [first]": r"algorithm must be a name, not \['first'\]",
    "run: 3": r"run must hold names and values, not 3",
    "- 1": r"holds no settings; write lines like",
    "": r"holds no settings",
    "a: [": r"cannot read settings from .*: while parsing a flow node",
    "a: \x00": r"cannot read settings from",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_a_mistake_in_a_file_is_named_on_one_line(tmp_path, text):
    with pytest.raises(UserError, match=MISTAKES[text]) as mistake:
        LINE.parse(["--config", a_file(tmp_path, text)])
    assert len(str(mistake.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config"], "--config needs a path"),
        (["--config", "nowhere.yaml"], "cannot read settings from nowhere.yaml: No such file"),
        (["--resume"], "--resume needs a path"),
        (["resume"], "Missing from train.py resume: PATH of the run"),
        (["third"], "unknown algorithm 'third'; choose one of first, second, resume"),
        (["frist"], "did you mean 'first'"),
        (["--resume", "there", "--seed", "1"], "Unrecognized options: --seed"),
    ],
)
def test_a_mistake_on_the_command_line_is_named(arguments, message):
    with pytest.raises(UserError, match=message):
        LINE.parse(arguments)


def test_a_file_of_one_algorithm_is_not_for_another(tmp_path):
    path = a_file(tmp_path, "algorithm: second")
    with pytest.raises(UserError, match="holds settings of second, not of first; leave the algorithm out"):
        LINE.parse(["first", "--config", path])


NAMES = st.sampled_from(["task", "seed", "out", "budget", "noise", "age_form", "in_sample", "run", "config"])
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.dates()
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=4
)
CONTENTS = st.dictionaries(NAMES | st.text(max_size=8), VALUES, max_size=4).map(yaml.safe_dump)
FILES = st.binary(max_size=60) | CONTENTS.map(str.encode)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=FILES)
def test_any_file_gives_options_or_one_line(tmp_path, content):
    path = tmp_path / "any.yaml"
    path.write_bytes(content)
    try:
        _, options = LINE.parse(["--config", str(path)])
    except UserError as error:
        assert len(str(error).splitlines()) == 1  # noqa: PT017  (either outcome is right)
    else:
        assert isinstance(options.run.seed, int)
        assert isinstance(options.algorithm.noise, float)
