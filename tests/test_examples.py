"""The examples keep their word: they run as they are, briefly, stay short, and learn."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch

FOLDER = Path(__file__).parents[1] / "examples"
LONGEST = 60  # lines


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_fits_a_screen(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST


def test_torchrls_own_ppo_takes_its_advantages_from_the_process(capsys):
    returns = load("ppo").train(updates=2, copies=2, steps=200, epochs=1)
    assert len(returns) == 2
    assert all(-2000 < value < 0 for value in returns)  # what the pendulum's cost allows
    sizes = [int(line.split()[-3]) for line in capsys.readouterr().out.splitlines() if "basis" in line]
    assert all(size > 20 for size in sizes)


def test_ten_lines_train_an_environment_of_ones_own(capsys):
    learner = load("own_environment").train(learners=2, copies=5, total_frames=2_500)
    assert learner.frames == 2_500
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    returns = torch.tensor([[float(value) for value in line[3:]] for line in lines])
    assert returns.shape == (5, 2)
    assert (returns[-2:].mean(0) > returns[0] + 5).all()  # of at most 50, one for each step at the origin


@pytest.mark.slow
def test_several_processes_train_one_learner(tmp_path):
    learner = load("several_processes").train(tmp_path / "learner.pt", updates=2, copies=1)
    saved = torch.load(tmp_path / "learner.pt", weights_only=True)
    assert saved["updates"] == learner.updates == 2
    assert learner.frames == 2 * 2 * 200


@pytest.mark.slow
def test_ppo_with_the_process_swings_the_pendulum_up():
    returns = load("ppo").train()
    assert max(returns[:3]) < -800
    assert sum(returns[-5:]) / 5 < 0
    assert sorted(returns[-15:])[7] > -500  # a pendulum that hangs has −1000 to −1600
