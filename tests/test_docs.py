"""The pages under docs/ keep their word: their code runs and prints what they say, and their links exist.

Printed numbers may differ by a few percent between machines; words may not.
"""

import contextlib
import io
import re
from pathlib import Path

import matplotlib
import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.glob("**/*.md"))
EXAMPLE = re.compile(r"```python\n(.*?)```(?:\s+```text\n(.*?)```)?", flags=re.DOTALL)
TESTS = [test for page in PAGES for test in re.findall(r"tests/[\w/]+\.py::\w+", page.read_text("utf-8"))]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def name(page: Path) -> str:
    return page.relative_to(DOCS).as_posix()


def test_there_are_pages_with_code_to_check():
    assert any(EXAMPLE.search(page.read_text(encoding="utf-8")) for page in PAGES)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_the_code_of_a_page_runs_and_prints_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names = {}
    text = page.read_text(encoding="utf-8")
    for program, expected in EXAMPLE.findall(text):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(program, page.name, "exec"), names)
        assert NUMBER.sub("#", printed.getvalue()) == NUMBER.sub("#", expected)
        numbers = [float(number) for number in NUMBER.findall(printed.getvalue())]
        assert numbers == pytest.approx([float(number) for number in NUMBER.findall(expected)], rel=0.1)
    for picture in tmp_path.iterdir():  # the page shows the pictures that its code makes
        assert f"]({picture.name})" in text


@pytest.mark.parametrize("test", TESTS)
def test_a_test_that_a_page_names_exists(test):
    file, function = test.split("::")
    assert f"def {function}(" in (DOCS.parent / file).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_the_links_of_a_page_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert "://" in target or (page.parent / target).exists(), target
