"""Resuming: a run that was killed anywhere and resumed leaves the metrics of one that was not."""

import multiprocessing
import os
import random
import resource
import signal
import sys
import time
from pathlib import Path

import pytest

import train

POLICY_GRADIENT = "policy-gradient --rollout-steps 20 --total-frames 320 --budget 15"
Q_LEARNING = "q-learning --rollout-steps 10 --total-frames 160 --budget 15 --sweeps 3"
EVERY_LEARNER = [
    POLICY_GRADIENT,
    Q_LEARNING,
    "actor-critic --rollout-steps 10 --total-frames 160 --budget 15 --first-frames 40 --batch 16",
    "dynamic-programming --rollout-steps 10 --total-frames 160 --model-budget 15 --support 20 --sweeps 3",
]
OTHERS = [
    f"{POLICY_GRADIENT} --critic neural",
    f"{POLICY_GRADIENT} --targets differences --estimator all-action --replay 100",
    f"{POLICY_GRADIENT} --targets differences --replay 100 --replay-storage disk",
    f"{Q_LEARNING} --replay-storage disk",
    f"{POLICY_GRADIENT} --task HalfCheetah-v5",  # starts are drawn by Gymnasium's generators
    f"{Q_LEARNING} --exploration gibbs",
    f"{Q_LEARNING} --exploration thompson",
    f"{POLICY_GRADIENT} --exploration confidence",
    f"{POLICY_GRADIENT} --kernel geodesic",
    f"{Q_LEARNING} --targets online",
]
COMMON = "--learners 2 --num-envs 2 --logger csv --checkpoint-interval"


# Forks of a process that has imported everything and runs no threads: a fork of this one could hang on them.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["train"])


def trained(arguments: list[str], longest_file: int | None) -> None:
    """The command line without evaluation and pictures, which take longer, in silence."""
    if longest_file is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (longest_file, resource.RLIM_INFINITY))
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    train.conclude = lambda *finished: None
    sys.exit(train.main(arguments))


def run(arguments: list[str], kill_after: float | None = None, longest_file: int | None = None) -> int | None:
    """The exit code, or None if the run was killed after some seconds."""
    process = SERVER.Process(target=trained, args=(arguments, longest_file))
    process.start()
    process.join(kill_after)
    process.kill()
    process.join()
    return None if process.exitcode == -signal.SIGKILL else process.exitcode


@pytest.fixture(
    scope="module", params=[POLICY_GRADIENT, *(pytest.param(o, marks=pytest.mark.slow) for o in OTHERS)]
)
def undisturbed(request, tmp_path_factory):
    """Name and options of a run, its metrics, and how long it took."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    arguments = [*request.param.split(), *COMMON.split()]
    assert run(["tasks"]) == 0  # the server has started
    started = time.monotonic()
    assert run([*arguments, "1000", "--out", str(folder)]) == 0
    return arguments, (folder / "metrics.csv").read_bytes(), time.monotonic() - started


def resumed_metrics(arguments: list[str], folder: Path, moments: list[float]) -> bytes:
    """Start, kill and resume, once for each moment, then to the end."""
    command = [*arguments, "--out", str(folder)]
    for moment in moments:
        if run(command, kill_after=moment) == 0:  # it was faster
            return (folder / "metrics.csv").read_bytes()
        started = (folder / "config.yaml").exists()
        command = ["--resume", str(folder)] if started else [*arguments, "--out", str(folder / "again")]
        folder = folder if started else folder / "again"
    assert run(command) == 0
    return (folder / "metrics.csv").read_bytes()


def kill_points(undisturbed, tmp_path, number: int) -> None:
    arguments, metrics, seconds = undisturbed
    chance = random.Random(len(arguments))
    for attempt in range(number):
        interval = chance.choice(["0", "0.1", "1000"])
        moments = [chance.uniform(0.02, seconds) for _ in range(chance.choice([1, 2]))]
        folder = tmp_path / f"{attempt}"
        assert resumed_metrics([*arguments, interval], folder, moments) == metrics, (interval, moments)


def test_a_killed_run_resumes_bit_for_bit(undisturbed, tmp_path):
    assert undisturbed[1].count(b"\n") == 17  # a header, and 8 updates of two learners
    kill_points(undisturbed, tmp_path, 3)


@pytest.mark.parametrize("undisturbed", [POLICY_GRADIENT], indirect=True)
def test_a_run_that_filled_the_disk_resumes_bit_for_bit(undisturbed, tmp_path):
    arguments, metrics, _ = undisturbed
    folder = tmp_path / "run"
    full = 8000  # bytes: room for options and the first metrics, not for a checkpoint
    assert run([*arguments, "0", "--out", str(folder)], longest_file=full) == 1
    assert list((folder / "checkpoints").glob("checkpoint-*.torchrl")) == []
    assert run(["--resume", str(folder)]) == 0
    assert (folder / "metrics.csv").read_bytes() == metrics


@pytest.mark.slow
@pytest.mark.parametrize("undisturbed", EVERY_LEARNER, indirect=True)
def test_a_killed_run_resumes_bit_for_bit_wherever_it_was_killed(undisturbed, tmp_path):
    kill_points(undisturbed, tmp_path, 20)
