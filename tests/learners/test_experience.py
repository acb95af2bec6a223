"""Experience: the newest transitions, the same in memory and in files, whatever becomes of the files."""

import io
import os
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torch_gprl.learners.experience import Experience

LEARNERS = 2


def steps(first: int, count: int) -> TensorDict:
    """Transitions that are known by their numbers."""
    number = torch.arange(first, first + count, dtype=torch.float32).expand(LEARNERS, -1)
    content = {"observation": torch.stack([number, -number], -1), "next": {"reward": number.unsqueeze(-1)}}
    return TensorDict(content, (LEARNERS, count))


def numbers(experience: Experience) -> list[int]:
    stored = experience.all()
    assert torch.equal(stored["observation"][..., :1], stored["next", "reward"])
    assert torch.equal(stored["observation"][0], stored["observation"][1])
    return stored["next", "reward"][0, :, 0].int().tolist()


def saved_and_loaded(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def an_experience(place: str, folder: Path, capacity: int = 10) -> Experience:
    experience = Experience(capacity)
    if place == "files":
        experience.keep_in(folder)
    return experience


@pytest.mark.parametrize("place", ["memory", "files"])
def test_the_oldest_gives_way_to_the_newest(place, tmp_path):
    experience = an_experience(place, tmp_path / "here")
    for first in (0, 4, 8):
        experience.extend(steps(first, 4))
    assert len(experience) == 10
    assert sorted(numbers(experience)) == list(range(2, 12))


@pytest.mark.parametrize("place", ["memory", "files"])
@pytest.mark.parametrize("seen", [0, 4, 8, 12, 20])
def test_a_saved_experience_goes_on_where_it_stood(place, seen, tmp_path):
    experience = an_experience(place, tmp_path / "one")
    for first in range(0, seen, 4):
        experience.extend(steps(first, 4))
    other = an_experience(place, tmp_path / "other")
    other.extend(steps(100, 7))
    other.load_state_dict(saved_and_loaded(experience.state_dict()))
    for first in (seen, seen + 4):
        assert len(other) == len(experience)
        assert not len(experience) or numbers(other) == numbers(experience)
        for one in (experience, other):
            one.extend(steps(first, 4))
    assert numbers(other) == numbers(experience)


def test_what_was_experienced_moves_to_files_that_others_can_read(tmp_path):
    experience = Experience(10)
    experience.extend(steps(0, 6))
    experience.keep_in(tmp_path / "here")
    experience.extend(steps(6, 2))
    assert numbers(experience) == list(range(8))
    read = TensorDict.load_memmap(tmp_path / "here")["next", "reward"]
    assert read[:8, 0, 0].tolist() == list(range(8))


@pytest.mark.parametrize("damage", ["lost", "cut", "overwritten"])
def test_files_damaged_between_two_runs_do_no_harm(damage, tmp_path):
    experience = an_experience("files", tmp_path / "here")
    experience.extend(steps(0, 8))
    state = saved_and_loaded(experience.state_dict())
    del experience
    files = list((tmp_path / "here").rglob("*.memmap"))
    assert len(files) >= 2
    for file in files:
        if damage == "lost":
            file.unlink()
        else:
            file.write_bytes(b"" if damage == "cut" else b"\xff" * file.stat().st_size)
    other = Experience(10)
    other.load_state_dict(state)
    other.keep_in(tmp_path / "here")
    other.extend(steps(8, 2))
    assert numbers(other) == list(range(10))


def test_room_on_the_disk_is_claimed_at_once(tmp_path):
    experience = an_experience("files", tmp_path, capacity=100_000)
    experience.extend(steps(0, 2))
    for file in tmp_path.rglob("*.memmap"):
        assert file.stat().st_blocks * 512 >= file.stat().st_size > 100_000


def test_a_full_disk_is_an_error_and_no_crash(tmp_path, monkeypatch):
    def full(*arguments: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    experience = an_experience("files", tmp_path)
    with pytest.raises(OSError, match="No space left on device"):
        experience.extend(steps(0, 2))
