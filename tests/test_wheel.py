"""What users install: the wheel holds the library alone, and works in an environment with nothing else."""

import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
IMPORT_EVERYTHING = """
import importlib, pkgutil, sys
import torch_gprl

names = 0
for part in pkgutil.iter_modules(torch_gprl.__path__, "torch_gprl."):
    package = importlib.import_module(part.name)
    for name in getattr(package, "__all__", ()):
        getattr(package, name)
        names += 1
assert torch_gprl.__file__.startswith(sys.prefix), torch_gprl.__file__
print(names, torch_gprl.__version__)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("build", reason="building the wheel needs the extra dev")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_holds_the_library_alone(wheel: Path):
    names = zipfile.ZipFile(wheel).namelist()
    assert {"torch_gprl/__init__.py", "torch_gprl/py.typed"} <= set(names)
    assert [name for name in names if not name.startswith(("torch_gprl/", "torch_gprl-"))] == []
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "torch_gprl").rglob("*.py")}
    assert sources <= set(names)


@pytest.mark.slow
def test_every_public_name_can_be_had_in_an_empty_environment(wheel: Path, tmp_path: Path):
    venv.create(tmp_path / "empty", with_pip=True)
    python = str(tmp_path / "empty" / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "-q", str(wheel)], check=True, cwd=tmp_path)
    # -I: neither the working directory nor PYTHONPATH can lend what the wheel lacks
    done = subprocess.run(
        [python, "-I", "-c", IMPORT_EVERYTHING], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    names, version = done.stdout.split()
    assert int(names) > 50
    assert version in wheel.name
