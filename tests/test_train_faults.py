"""What goes wrong while a run learns: environments that break, odd ones that are no faults, output unread."""

import contextlib
import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import envs
import train
from torch_gprl.runs import read_metrics

SMALL = {
    "policy-gradient": "--rollout-steps 20 --total-frames 240 --budget 15",
    "q-learning": "--rollout-steps 10 --total-frames 120 --sweeps 3 --budget 15",
    "dynamic-programming": "--rollout-steps 10 --total-frames 120 --model-budget 15 --support 20 --sweeps 3",
    "actor-critic": "--rollout-steps 10 --total-frames 120 --first-frames 40 --batch 16 --budget 15",
}
LEARNERS = [pytest.param(name, marks=[pytest.mark.slow] * (name != "policy-gradient")) for name in SMALL]
SIZES = "--learners 2 --num-envs 2 --logger csv --checkpoint-interval 1000"


def learned(name: str, folder: Path, task: str, options: str = "") -> int:
    """The exit code of a small run that is neither evaluated nor drawn."""
    sizes = f"{SIZES} {SMALL[name]} {options}".split()
    return train.main([name, *sizes, "--task", task, "--out", str(folder)])


@pytest.fixture
def task(monkeypatch):
    """A pendulum that tests may break; training alone, as evaluation and pictures take longer."""
    monkeypatch.setattr(train, "conclude", lambda *finished: None)
    kind = type(envs.ALL["pendulum-swingup"])

    class Fragile(kind):
        bad_from, constant, ends = 10**9, False, False
        steps = 0

        def reward(self, before, action, after):
            Fragile.steps += 1
            whole = super().reward(before, action, after)
            if Fragile.steps >= Fragile.bad_from:
                return whole._replace(total=whole.total * float("nan"))
            return whole._replace(total=0 * whole.total + 1) if Fragile.constant else whole

        def terminated(self, state):
            return super().terminated(state) | Fragile.ends

    whole = envs.ALL["pendulum-swingup"]
    fields = {field.name: getattr(whole, field.name) for field in dataclasses.fields(whole)}
    monkeypatch.setitem(envs.ALL, "fragile", Fragile(**{**fields, "id": "fragile"}))
    return Fragile


@pytest.mark.parametrize("name", LEARNERS)
def test_a_broken_environment_ends_the_run_with_its_cause_and_a_checkpoint_to_go_on_from(
    name, task, tmp_path, capsys
):
    assert learned(name, tmp_path / "whole", "fragile") == 0
    task.steps, task.bad_from = 0, 50
    assert learned(name, tmp_path / "broken", "fragile") == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert re.search(
        r"failed after update \d by FloatingPointError: the environment gave a reward that is not finite: .*"
        r"--resume .*broken goes on from the last checkpoint",
        line,
    )
    assert "Traceback" in (tmp_path / "broken" / "failure.txt").read_text(encoding="utf-8")

    task.bad_from = 10**9
    assert train.main(["--resume", str(tmp_path / "broken")]) == 0
    assert not (tmp_path / "broken" / "failure.txt").exists()
    written = [(tmp_path / run / "metrics.csv").read_bytes() for run in ("whole", "broken")]
    assert written[0] == written[1]


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("oddity", ["constant", "ends"])
def test_constant_rewards_and_episodes_of_one_step_are_no_faults(name, oddity, task, tmp_path):
    setattr(task, oddity, True)
    assert learned(name, tmp_path / "run", "fragile") == 0
    metrics = read_metrics(tmp_path / "run" / "metrics.csv")
    assert metrics["update"][:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    if oddity == "ends":
        assert np.isfinite(metrics["return"]).all()  # an episode ends at every step


# ---------------------------------------------------------------- experience in files


def damage(experience: Path) -> None:
    """Cut one file, lose another, and spoil the rest."""
    cut, lost, *others = sorted(experience.rglob("*.memmap"))
    cut.write_bytes(b"")
    lost.unlink()
    for other in others:
        other.write_bytes(b"\xff" * other.stat().st_size)


@pytest.mark.parametrize(
    "name", ["q-learning", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SMALL)[2:])]
)
def test_experience_in_files_changes_nothing_even_if_they_are_damaged_before_a_run_is_resumed(
    name, tmp_path, task
):
    assert learned(name, tmp_path / "memory", "fragile") == 0
    assert learned(name, tmp_path / "disk", "fragile", "--replay-storage disk") == 0
    metrics = (tmp_path / "memory" / "metrics.csv").read_bytes()
    assert (tmp_path / "disk" / "metrics.csv").read_bytes() == metrics
    damage(tmp_path / "disk" / "experience")
    assert train.main(["--resume", str(tmp_path / "disk"), "--checkpoint", "1"]) == 0
    assert (tmp_path / "disk" / "metrics.csv").read_bytes() == metrics


# ---------------------------------------------------------------- output that nobody reads


@contextlib.contextmanager
def a_reader_that_has_gone() -> Iterator[None]:
    """Within it nobody reads standard output any more, as behind `| head`."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as output, contextlib.redirect_stdout(output):
        yield


@pytest.mark.parametrize("command", ["tasks", "--help"])
def test_a_command_whose_output_is_not_read_to_the_end_ends_without_an_error(command):
    with a_reader_that_has_gone():
        assert train.main([command]) == 0


def test_a_run_whose_output_nobody_reads_goes_on_to_its_end(task, tmp_path):
    with a_reader_that_has_gone():
        assert learned("policy-gradient", tmp_path / "run", "fragile") == 0
    assert read_metrics(tmp_path / "run" / "metrics.csv")["update"][-1, 0] == 6
