"""The house rules that no linter checks: sizes of files and functions, and a purpose for each module."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST_FILE = 400  # lines
LONGEST_FUNCTION = 60  # lines, docstring not counted: what fits a screen
FOLDERS = ("torch_gprl", "envs", "experiments", "benchmarks")


def sources() -> list[Path]:
    found = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    return [*found, ROOT / "train.py"] if (ROOT / "train.py").exists() else found


def functions(tree: ast.Module) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def body_length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines from the first statement after the docstring to the last."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_body_length_leaves_out_the_docstring():
    tree = ast.parse('def f():\n    """Say.\n\n    More.\n    """\n    x = 1\n    return x\n')
    assert [body_length(function) for function in functions(tree)] == [2]


@pytest.mark.parametrize("path", sources(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_file_keeps_the_house_rules(path: Path):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    too_long = [f"{f.name} ({body_length(f)})" for f in functions(tree) if body_length(f) > LONGEST_FUNCTION]

    assert len(text.splitlines()) <= LONGEST_FILE
    assert not too_long, f"functions of more than {LONGEST_FUNCTION} lines: {', '.join(too_long)}"
    assert ast.get_docstring(tree), "the module does not say what it is for"
