"""Checkpoints: bit-equal restoration, and a clear word on every file that is not what it should be."""

import pickle
import random
import resource
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torchrl.checkpoint import CheckpointError

from torch_gprl.runs import Checkpoints, UserError


class Learner:
    """A state such as learners have: a module, an optimiser, plain numbers."""

    def __init__(self, hidden: int = 4, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.module = nn.Linear(3, hidden)
        self.optimiser = torch.optim.Adam(self.module.parameters())
        self.updates = 0

    def step(self) -> None:
        self.optimiser.zero_grad()
        self.module(torch.randn(8, 3)).square().sum().backward()
        self.optimiser.step()
        self.updates += 1

    def state_dict(self) -> dict:
        return {
            "module": self.module.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict) -> None:
        self.module.load_state_dict(state["module"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.updates = state["updates"]


def a_checkpoint(directory: Path) -> Path:
    learner = Learner()
    learner.step()
    return Checkpoints(directory, learner=learner).save(1)


def test_a_restored_run_continues_bit_for_bit(tmp_path):
    learner = Learner()
    learner.step()
    path = Checkpoints(tmp_path, learner=learner).save(1)
    learner.step()

    other = Learner(seed=7)
    Checkpoints(tmp_path, learner=other).load(path)
    other.step()

    assert other.updates == learner.updates == 2
    for restored, kept in zip(other.module.parameters(), learner.module.parameters(), strict=True):
        assert torch.equal(restored, kept)


def test_every_generator_goes_on_where_it_was(tmp_path):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    path = checkpoints.save(1)
    drawn = (torch.rand(()).item(), np.random.rand(), random.random())
    checkpoints.load(path)
    assert (torch.rand(()).item(), np.random.rand(), random.random()) == drawn


def test_the_last_two_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    paths = [checkpoints.save(step) for step in (1, 2, 10)]
    assert sorted(tmp_path.iterdir()) == paths[1:]
    assert checkpoints.latest() == paths[2]


@pytest.mark.parametrize("kept", [100, -1])
def test_of_a_damaged_checkpoint_the_last_good_one_is_named(tmp_path, kept):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    first, second = checkpoints.save(9), checkpoints.save(10)
    second.write_bytes(second.read_bytes()[:kept])  # a power failure
    assert checkpoints.latest() == second
    with pytest.raises(UserError, match="the file is damaged, but checkpoint 9 is whole: --checkpoint 9"):
        checkpoints.load(second)
    assert checkpoints.at(9) == first
    checkpoints.load(first)


def test_with_no_good_checkpoint_none_is_named(tmp_path):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    for path in (checkpoints.save(1), checkpoints.save(2)):
        path.write_bytes(b"")
    with pytest.raises(UserError, match="must be whole and from a run with the same options"):
        checkpoints.load(checkpoints.latest())


def test_a_checkpoint_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    checkpoints.save(3), checkpoints.save(20)
    with pytest.raises(UserError, match=r"there is no checkpoint 7 in .*; there are: 3, 20"):
        checkpoints.at(7)


def test_what_a_kill_left_of_a_checkpoint_is_swept_away_by_the_next(tmp_path):
    checkpoints = Checkpoints(tmp_path, learner=Learner())
    first = checkpoints.save(1)
    (tmp_path / ".checkpoint-000000000002.torchrl.archive-0f").write_bytes(b"half")
    (tmp_path / ".checkpoint-000000000002.torchrl.stage-0f" / "components").mkdir(parents=True)
    assert checkpoints.latest() == first
    second = checkpoints.save(2)
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_a_full_disk_leaves_the_last_checkpoint(tmp_path):
    learner = Learner()
    checkpoints = Checkpoints(tmp_path, learner=learner)
    path = checkpoints.save(1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))  # every longer file fails as on a full disk
    try:
        with pytest.raises((OSError, RuntimeError, CheckpointError)):
            checkpoints.save(2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoints.latest() == path
    checkpoints.load(path)
    assert checkpoints.save(2) == checkpoints.latest()


def test_without_checkpoints_there_is_no_latest(tmp_path):
    assert Checkpoints(tmp_path, learner=Learner()).latest() is None


def test_a_failed_save_leaves_the_last_checkpoint(tmp_path):
    learner = Learner()
    checkpoints = Checkpoints(tmp_path, learner=learner)
    path = checkpoints.save(1)
    before = path.read_bytes()
    learner.updates = lambda: None  # cannot be pickled: the save breaks half way
    with pytest.raises(Exception, match=r"pickle|local"):
        checkpoints.save(1)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == before


def test_no_damage_goes_unnoticed(tmp_path):
    """Cut anywhere, or with a byte of the tensors changed, the file is refused and nothing taken over."""
    path = a_checkpoint(tmp_path)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        payload = max(archive.infolist(), key=lambda info: info.file_size)
    inside = range(payload.header_offset + 200, payload.header_offset + payload.file_size, 997)
    damaged = [whole[:cut] for cut in range(0, len(whole), len(whole) // 7)]
    damaged += [whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :] for place in inside]
    for content in damaged:
        path.write_bytes(content)
        learner = Learner(seed=3)
        before = [parameter.clone() for parameter in learner.module.parameters()]
        with pytest.raises(UserError, match="cannot load checkpoint"):
            Checkpoints(tmp_path, learner=learner).load(path)
        assert all(map(torch.equal, learner.module.parameters(), before))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"cannot load checkpoint .*nowhere.* does not exist"):
        Checkpoints(tmp_path, learner=Learner()).load(tmp_path / "nowhere")


def test_a_foreign_file_is_refused(tmp_path):
    torch.save({"weights": torch.zeros(3)}, tmp_path / "model.pt")
    (tmp_path / "notes.txt").write_text("hello", encoding="utf-8")
    for name in ("model.pt", "notes.txt"):
        with pytest.raises(UserError, match=f"cannot load checkpoint .*{name}"):
            Checkpoints(tmp_path, learner=Learner()).load(tmp_path / name)


def test_another_shape_is_refused_before_anything_is_taken_over(tmp_path):
    path = a_checkpoint(tmp_path)
    learner = Learner(hidden=5)
    before = learner.module.weight.clone()
    with pytest.raises(UserError, match=r"module.weight has shape \[4, 3\], this run needs \[5, 3\]"):
        Checkpoints(tmp_path, learner=learner).load(path)
    assert torch.equal(learner.module.weight, before)


def test_a_missing_part_is_named(tmp_path):
    path = a_checkpoint(tmp_path)

    class More(Learner):
        def state_dict(self) -> dict:
            return {**super().state_dict(), "critic": {"basis": torch.zeros(2)}}

    with pytest.raises(UserError, match=r"it lacks critic\.basis"):
        Checkpoints(tmp_path, learner=More()).load(path)


def test_a_newer_format_is_refused(tmp_path):
    path = a_checkpoint(tmp_path)
    newer = tmp_path / "newer.torchrl"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(newer, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "manifest.json":
                content = content.replace(b'"adapter_version": 1', b'"adapter_version": 2')
            new.writestr(name, content)
    with pytest.raises(UserError, match="adapter version is 2, target adapter version is 1"):
        Checkpoints(tmp_path, learner=Learner()).load(newer)


def test_a_checkpoint_cannot_run_code(tmp_path):
    path = a_checkpoint(tmp_path)
    proof = tmp_path / "proof"

    class Malice:
        def __reduce__(self) -> tuple:
            return (open, (str(proof), "w"))

    evil = tmp_path / "evil.torchrl"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(evil, "w") as new:
        for name in old.namelist():
            new.writestr(name, pickle.dumps(Malice()) if name.endswith("state.pt") else old.read(name))
    with pytest.raises(UserError, match="damaged or not plain"):
        Checkpoints(tmp_path, learner=Learner()).load(evil)
    assert not proof.exists()
