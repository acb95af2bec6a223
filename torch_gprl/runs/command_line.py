"""Command lines from commented dataclasses, and their settings from files; every mistake is one line.

tyro turns a dataclass into options. Settings of a file, and presets of a task, become options too, put before
those of the command line, so that all are checked alike and the command line wins.
"""

import contextlib
import dataclasses
import difflib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tyro
import yaml

from torch_gprl.runs.errors import UserError

BOX_SIDES, BOX_RULES = "│| ", "─-"  # how tyro draws with UTF-8 and without
SECTIONS = ("run", "config")  # of a run's config.yaml
RECORDS = ("command", "started", "git_commit", "versions")  # in a run's config.yaml, and no settings
LONGEST_WORD = 60  # characters of what a file holds, in a message

Options = TypeVar("Options")


@dataclass(frozen=True)
class Algorithm:
    """A way to learn, as the command line offers it.

    Attributes:
        options: a dataclass of two dataclasses: `run`, which has a `task`, and `algorithm`.
        learner: the class that does it.
        presets: task -> options that replace the defaults there.
    """

    options: type
    learner: type
    presets: Mapping[str, Mapping[str, object]] = field(default_factory=dict)

    @classmethod
    def offered(
        cls,
        learner: type,
        run: object,
        numbers: object,
        presets: Mapping[str, Mapping[str, object]] | None = None,
    ) -> "Algorithm":
        """An algorithm with options made of those of a run and its own numbers.

        Args:
            learner: the class that does it.
            run: a frozen dataclass with the defaults of the run.
            numbers: a frozen dataclass with the defaults of the algorithm; its docstring heads `--help`.
            presets: task -> options that replace the defaults there.
        """
        fields = [
            (name, tyro.conf.OmitArgPrefixes[type(part)], field(default_factory=lambda part=part: part))
            for name, part in (("run", run), ("algorithm", numbers))
        ]
        options = dataclasses.make_dataclass(
            "Options", fields, frozen=True, namespace={"__doc__": type(numbers).__doc__}
        )
        return cls(options, learner, presets or {})

    def parts(self) -> list[type]:
        """The dataclasses that hold the options."""
        default = self.options()
        return [type(default.run), type(default.algorithm)]


@dataclass(frozen=True)
class CommandLine:
    """A program that learns by one of several algorithms, and has other commands beside.

    Attributes:
        overview: what `--help` alone shows.
        algorithms: name -> what it is; the first one is meant where none is named.
        commands: name -> options of the command; `resume` is among them.
    """

    overview: str
    algorithms: Mapping[str, Algorithm]
    commands: Mapping[str, type]

    def parse(self, arguments: Sequence[str]) -> tuple[str, Any]:
        """Turn arguments into the name of an algorithm or a command, and its options.

        Raises:
            UserError: if they are wrong.
        """
        named = bool(arguments) and not arguments[0].startswith("-")
        name, rest = (arguments[0], arguments[1:]) if named else (None, arguments)
        if name is not None and name in self.commands:
            return name, parse_options(self.commands[name], rest, f"train.py {name}")
        if name is not None and name not in self.algorithms:
            names = [*self.algorithms, *self.commands]
            raise UserError(f"unknown algorithm '{name}'; {nearest(name, names)}")
        if name is None and list(rest) in (["--help"], ["-h"]):
            print(self.overview)
            raise SystemExit(0)
        resumed, rest = _taken(rest, "--resume")
        if resumed is not None:
            return "resume", parse_options(self.commands["resume"], [resumed, *rest], "train.py --resume")
        file, rest = _taken(rest, "--config")
        if file is None:
            return self._with_presets(name or next(iter(self.algorithms)), rest)
        meant, settings = self.settings_of(Path(file), name)
        return self._with_presets(meant, [*settings, *rest])

    def settings_of(self, path: Path, name: str | None = None) -> tuple[str, list[str]]:
        """The algorithm that a file of settings is for, and the settings as arguments, checked.

        Args:
            path: a YAML file.
            name: the algorithm asked for, if any.

        Raises:
            UserError: if the file is wrong, or for another algorithm.
        """
        meant, settings = read_settings(path)
        if name and meant and name != meant:
            raise UserError(f"{path} holds settings of {meant}, not of {name}; leave the algorithm out")
        meant = name or meant or next(iter(self.algorithms))
        if meant not in self.algorithms:
            raise UserError(f"{path}: unknown algorithm '{shown(meant)}'; {nearest(meant, self.algorithms)}")
        algorithm = self.algorithms[meant]
        arguments = as_arguments(settings, algorithm.parts(), path)
        try:
            parse_options(algorithm.options, arguments, f"train.py {meant}")
        except UserError as error:
            raise UserError(f"{path}: {error}") from error
        return meant, arguments

    def _with_presets(self, name: str, arguments: Sequence[str]) -> tuple[str, Any]:
        """An algorithm's options: its defaults, under the presets of the task, under the arguments."""
        algorithm, program = self.algorithms[name], f"train.py {name}"
        presets = {
            task: as_arguments(preset, algorithm.parts(), "presets")
            for task, preset in algorithm.presets.items()
        }
        told = [f"{task}: {' '.join(preset)}" for task, preset in presets.items()]
        description = (
            f"{algorithm.options.__doc__}\n\nOther defaults of some tasks: {'; '.join(told) or 'none'}."
        )
        options = parse_options(algorithm.options, arguments, program, description)
        if options.run.task not in presets:
            return name, options
        return name, parse_options(algorithm.options, [*presets[options.run.task], *arguments], program)


def _taken(arguments: Sequence[str], flag: str) -> tuple[str | None, list[str]]:
    """The value of an option, and the other arguments."""
    arguments = list(arguments)
    for place, argument in enumerate(arguments):
        if argument == flag:
            if place + 1 == len(arguments):
                raise UserError(f"{flag} needs a path")
            return arguments[place + 1], arguments[:place] + arguments[place + 2 :]
        if argument.startswith(f"{flag}="):
            return argument.split("=", 1)[1], arguments[:place] + arguments[place + 1 :]
    return None, arguments


def parse_options(
    kind: type[Options], arguments: Sequence[str], program: str, description: str | None = None
) -> Options:
    """Turn arguments into options.

    Args:
        kind: a dataclass, every field with a comment.
        arguments: what follows the program's name.
        program: its name in `--help`.
        description: head of `--help`; the dataclass's docstring unless given.

    Raises:
        UserError: what tyro would show in a box, on one line.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=arguments, prog=program, description=description)
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise UserError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    """The text of tyro's box without the box and its colours: its parts joined by semicolons."""
    parts: list[list[str]] = [[]]
    for line in re.sub(r"\x1b\[[\d;]*m", "", box).splitlines()[1:-1]:
        words = line.strip(BOX_SIDES).split()
        if set("".join(words)) <= set(BOX_RULES):
            parts.append([])
        else:
            parts[-1] += words
    return "; ".join(" ".join(part) for part in parts)


def nearest(name: str, names: Iterable[str]) -> str:
    """What a message says of a wrong name: the one that may have been meant, and all."""
    names = list(names)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    hint = f"did you mean '{near[0]}'? Or choose" if near else "choose"
    return f"{hint} one of {', '.join(names)}"


def read_settings(path: Path) -> tuple[str | None, dict[str, object]]:
    """The algorithm and the options of a YAML file: a run's `config.yaml`, or names and values by hand.

    Raises:
        UserError: if the file cannot be read or is no list of names with values.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise UserError(f"cannot read settings from {path}: {reason}") from error
    if not isinstance(content, Mapping):
        raise UserError(f"{path} holds no settings; write lines like 'learners: 5'")
    settings = {name: value for name, value in content.items() if name not in RECORDS}
    algorithm = settings.pop("algorithm", None)
    if algorithm is not None and not isinstance(algorithm, str):
        raise UserError(f"{path}: algorithm must be a name, not {shown(algorithm)}")
    for section in SECTIONS:
        options = settings.pop(section, None) or {}
        if not isinstance(options, Mapping):
            raise UserError(f"{path}: {section} must hold names and values, not {shown(options)}")
        settings |= options
    return algorithm, {str(name): value for name, value in settings.items()}


def as_arguments(settings: Mapping[str, object], kinds: Sequence[type], source: object) -> list[str]:
    """Settings as arguments of a command line.

    Args:
        settings: option -> value, with underscores; None leaves an option at its default. Options that are
            dataclasses hold names and values, which become options of their own, as tyro makes them.
        kinds: the dataclasses that have the options.
        source: where the settings come from, for messages.

    Raises:
        UserError: if there is no such option, or the value is not a single one.
    """
    types: dict[str, Any] = {field.name: field.type for kind in kinds for field in dataclasses.fields(kind)}
    arguments = []
    for name, value in settings.items():
        if name not in types:
            raise UserError(f"{source}: unknown setting '{shown(name)}'; {nearest(name, types)}")
        flag = name.replace("_", "-")
        if dataclasses.is_dataclass(types[name]):
            if not isinstance(value, Mapping):
                raise UserError(f"{source}: {name} must hold names and values, not {shown(value)}")
            arguments += as_arguments(value, [types[name]], source)
        elif types[name] is bool:
            if not isinstance(value, bool):
                raise UserError(f"{source}: {name} must be true or false, not {shown(value)}")
            arguments.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, Mapping | list | tuple | set | bytes):
            raise UserError(f"{source}: {name} must be a single value, not {shown(value)}")
        elif value is not None:
            arguments.append(f"--{flag}={value}")
    return arguments


def shown(value: object) -> str:
    """A value for a message: short, and on one line."""
    text = " ".join(str(value).split())
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= LONGEST_WORD else f"{text[:LONGEST_WORD]}..."
