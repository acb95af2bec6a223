"""The command line's collectors: whole runs by workers, resumed runs, and what is said when one fails."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import train
from torch_gprl.runs import read_metrics

ROOT = Path(__file__).parents[1]
ALONE = {**os.environ, "OMP_NUM_THREADS": "1"}


def test_a_collector_needs_workers(capsys):
    assert train.main(["--collector", "ray"]) == 2
    assert "say how many by --workers" in capsys.readouterr().err


def test_a_missing_ray_is_the_users_to_mend(monkeypatch, capsys, tmp_path):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "ray" else find(name, *rest)
    )
    arguments = ["--collector", "ray", "--workers", "1", "--out", str(tmp_path / "run")]
    assert train.main(arguments) == 2
    assert "pip install 'torch-gprl[ray]'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("collector", "algorithm"),
    [("multi-sync", "policy-gradient"), ("multi-async", "q-learning"), ("ray", "policy-gradient")],
)
def test_workers_leave_a_whole_run(collector, algorithm, tmp_path):
    if collector == "ray":
        pytest.importorskip("ray", reason="needs the extra ray")
    size = "--learners 2 --num-envs 2 --total-frames 800 --budget 20 --evaluation-episodes 1"
    arguments = [algorithm, "--collector", collector, "--workers", "2", *size.split()]
    done = subprocess.run(
        [sys.executable, "train.py", *arguments, "--out", str(tmp_path / "run")],
        cwd=ROOT,
        env=ALONE,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert read_metrics(tmp_path / "run" / "metrics.csv")["return"].shape[1] == 2
    assert (tmp_path / "run" / "report.html").exists()


SMALL = "--workers 2 --learners 2 --num-envs 2 --logger csv --budget 15 --rollout-steps 20"


def begun(folder: Path, updates: int, options: str) -> subprocess.Popen[str]:
    """A run that has made so many updates and a checkpoint, and goes on."""
    command = [sys.executable, "train.py", *options.split(), *SMALL.split(), "--out", str(folder)]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=ALONE, start_new_session=True
    )
    metrics, deadline = folder / "metrics.csv", time.monotonic() + 200
    while not (
        any(folder.glob("checkpoints/checkpoint-*"))
        and metrics.read_text(encoding="utf-8").count("\n") > 2 * updates
    ):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return process


def ends_soon(group: int) -> bool:
    """Whether all processes of a group end within a minute."""
    for _ in range(600):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
def test_a_killed_worker_ends_the_run_with_its_cause_and_a_checkpoint(tmp_path):
    process = begun(tmp_path / "run", 1, "policy-gradient --total-frames 1000000000")
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="utf-8").split()
    names = {child: Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8") for child in children}
    worker = next(child for child, name in names.items() if "spawn_main" in name)
    os.kill(int(worker), signal.SIGKILL)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert re.search(
        r"failed after update \d+ by RuntimeError: a worker failed: worker-0 .*--resume .*",
        errors.splitlines()[-1],
    )
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "algorithm", ["policy-gradient --exploration confidence", "q-learning --sweeps 3 --exploration thompson"]
)
def test_a_killed_run_with_workers_resumes_bit_for_bit_and_leaves_no_process(
    algorithm, tmp_path, monkeypatch
):
    monkeypatch.setattr(train, "conclude", lambda *finished: None)  # evaluation and pictures take longer
    options = f"{algorithm} --total-frames 400 --checkpoint-interval 0"
    process = begun(tmp_path / "killed", 3, options)
    process.kill()
    process.communicate()
    assert ends_soon(process.pid)
    assert train.main(["--resume", str(tmp_path / "killed")]) == 0
    assert train.main([*options.split(), *SMALL.split(), "--out", str(tmp_path / "whole")]) == 0
    metrics = [(tmp_path / run / "metrics.csv").read_bytes() for run in ("killed", "whole")]
    assert metrics[0].count(b"\n") == 21  # a header, and ten updates of two learners
    assert metrics[0] == metrics[1]
