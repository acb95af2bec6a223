"""The README keeps its word: its examples run and print what it says, its commands and links exist."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

import train

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```\s+```text\n(.*?)```", TEXT, flags=re.DOTALL)
COMMANDS = [
    line for block in re.findall(r"```sh\n(.*?)```", TEXT, flags=re.DOTALL) for line in block.splitlines()
]


def test_there_are_examples_and_commands_to_check():
    assert len(EXAMPLES) == TEXT.count("```python") == 1
    assert len(COMMANDS) >= 4


@pytest.mark.parametrize(("program", "output"), EXAMPLES)
def test_an_example_prints_what_the_readme_says(program, output):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(program, "README.md", "exec"), {})
    assert printed.getvalue() == output


def test_two_single_lines_install_and_run_the_main_job_and_the_tests():
    from_nothing = [line for line in COMMANDS if line.startswith("python3 -m venv")]
    assert [line.split()[-1] for line in from_nothing] == ["train.py", "pytest"]


def arguments_of_train() -> list[list[str]]:
    """What the README's commands pass to train.py."""
    lines = [shlex.split(line, comments=True) for line in COMMANDS if "train.py" in line]
    return [words[words.index("train.py") + 1 :] for words in lines]


@pytest.mark.parametrize("arguments", arguments_of_train(), ids=" ".join)
def test_the_command_line_understands_the_readme(arguments, capsys):
    if "--help" in arguments:
        with pytest.raises(SystemExit, match="0"):
            train.parse(arguments)
    else:
        train.parse(arguments)


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#]+)\)", TEXT))
def test_a_link_within_the_repository_leads_somewhere(target):
    if "://" not in target:
        assert (ROOT / target).exists()
