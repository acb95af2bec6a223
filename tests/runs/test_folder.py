"""The run folder: what it holds, and what it refuses."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import yaml

import torch_gprl
from torch_gprl.runs import RunFolder, UserError


@dataclass(frozen=True)
class Options:
    step_size: float = 0.1
    shape: tuple[int, int] = (2, 3)
    out: Path | None = None
    dtype: torch.dtype = torch.float64


def read_config(folder: RunFolder) -> dict:
    return yaml.safe_load((folder.path / "config.yaml").read_text(encoding="utf-8"))


def test_a_new_folder_has_its_places(tmp_path):
    folder = RunFolder(tmp_path / "deep" / "run")
    assert sorted(place.name for place in folder.path.iterdir()) == ["checkpoints", "figures", "videos"]


def test_the_config_holds_the_options_in_plain_types(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config({"algorithm": "policy-gradient", "config": Options(out=Path("there"))})
    written = read_config(folder)
    assert written["algorithm"] == "policy-gradient"
    assert written["config"] == {
        "step_size": 0.1,
        "shape": [2, 3],
        "out": "there",
        "dtype": "torch.float64",
    }


def test_the_config_names_what_the_numbers_depend_on(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config({})
    written = read_config(folder)
    assert written["versions"]["torch"] == torch.__version__
    assert written["versions"]["torch_gprl"] == torch_gprl.__version__
    assert written["command"]
    here = Path(__file__).parent
    commit = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True)
    expected = commit.stdout.strip() or None
    assert (written["git_commit"] or "").removesuffix("-dirty") == (expected or "")


def test_two_runs_of_the_same_second_get_two_folders(tmp_path):
    folders = {RunFolder.named("pendulum-swingup", "policy-gradient", root=tmp_path).path for _ in range(3)}
    assert len(folders) == 3
    assert all(path.name.startswith("pendulum-swingup-policy-gradient-") for path in folders)


def test_a_task_with_a_slash_makes_one_folder(tmp_path):
    assert RunFolder.named("gym/Ant-v5", "policy-gradient", root=tmp_path).path.parent == tmp_path


def test_a_folder_in_use_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious", encoding="utf-8")
    with pytest.raises(UserError, match="not empty; name another"):
        RunFolder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write run folder .*file"):
        RunFolder(tmp_path / "file" / "run")


def test_the_evaluation_lists_every_episode(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_evaluation(torch.tensor([[1.5, 2.0], [0.1, 4.0]], dtype=torch.float64))
    assert (folder.path / "evaluation.csv").read_text(encoding="utf-8").split() == [
        "learner,episode,return",
        "0,0,1.5",
        "0,1,2.0",
        "1,0,0.1",
        "1,1,4.0",
    ]
