"""The command line's collectors: what does not fit is one line, and workers leave a whole run."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

import train
from torch_gprl.runs import read_metrics

ROOT = Path(__file__).parents[1]


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
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert read_metrics(tmp_path / "run" / "metrics.csv")["return"].shape[1] == 2
    assert (tmp_path / "run" / "report.html").exists()
