"""Checkpoints: whole states of a run, written so that a crash at any moment leaves a readable one.

The container is TorchRL's (`torchrl.checkpoint`): one zip file with a manifest and checksums, written under a
temporary name and renamed. Added here: tensors and plain numbers only (nothing in the file can run code), a
comparison of shapes before anything is overwritten, and a flush to the disk.
"""

import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointRotation,
    GlobalRNGState,
)

from torch_gprl.runs.errors import UserError

NAME = re.compile(r"checkpoint-(\d+)\.torchrl")
LEFT_BY_A_KILL = ".checkpoint-*"  # what TorchRL had not yet renamed
KEPT = 2  # the newest, and the one before in case the newest was cut off by a crash


@runtime_checkable
class Stateful(Protocol):
    """Anything with a state of tensors and plain numbers."""

    def state_dict(self) -> dict[str, Any]:
        """The whole state."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any], /) -> object:
        """Take over a state."""
        ...


class Checkpoints:
    """The checkpoints of one run, newest last; the last two are kept.

    The states of the random number generators are saved and restored with every checkpoint.

    Args:
        directory: where the files lie.
        components: what is saved, by name.
    """

    def __init__(self, directory: Path, **components: Stateful) -> None:
        self._rotation = CheckpointRotation(directory, keep_last=KEPT)
        self._checkpoint = Checkpoint(format="archive")
        for name, component in {**components, "random_numbers": GlobalRNGState()}.items():
            self._checkpoint.register(name, component, adapter=_PlainState())

    def save(self, step: int) -> Path:
        """Write a checkpoint and delete those before the last two.

        Args:
            step: orders the checkpoints, e.g. the number of the update.

        Returns:
            The new file.
        """
        for left in self._rotation.directory.glob(LEFT_BY_A_KILL):
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        path = self._rotation.save(self._checkpoint, step=step)
        for place in (path, path.parent):  # the file's bytes, then its name
            descriptor = os.open(place, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        return path

    def latest(self) -> Path | None:
        """The newest checkpoint, if there is one; it may be damaged."""
        files = self._files()
        return files[max(files)] if files else None

    def at(self, step: int) -> Path:
        """The checkpoint of a step.

        Raises:
            UserError: if there is none; the message names those there are.
        """
        files = self._files()
        if step not in files:
            there = ", ".join(map(str, sorted(files))) or "none"
            raise UserError(
                f"there is no checkpoint {step} in {self._rotation.directory}; there are: {there}"
            )
        return files[step]

    def _files(self) -> dict[int, Path]:
        """Step -> file, of good checkpoints and damaged ones."""
        names = {path: NAME.fullmatch(path.name) for path in self._rotation.directory.glob("*")}
        return {int(name[1]): path for path, name in names.items() if name}

    def load(self, path: Path) -> None:
        """Restore all components from a file.

        Raises:
            UserError: if the file is missing, damaged, of another format, or of a run with other shapes; if
                it is damaged the message names the newest one that is not.
        """
        try:
            self._checkpoint.load(path)
        except (CheckpointError, zipfile.BadZipFile, OSError, ValueError, KeyError, EOFError) as error:
            reason = " ".join(str(error).split())
            raise UserError(f"cannot load checkpoint {path}: {reason} ({self._way_out(path)})") from error

    def _way_out(self, path: Path) -> str:
        if _is_whole(path):
            return "the file must be from a run with the same options"
        good = [step for step, other in self._files().items() if other != path and _is_whole(other)]
        if good:
            return f"the file is damaged, but checkpoint {max(good)} is whole: --checkpoint {max(good)}"
        return "the file must be whole and from a run with the same options"


def _is_whole(path: Path) -> bool:
    """Whether the checksums of a file hold."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        return False


class _PlainState(CheckpointAdapter):
    """Saves a state with `torch.save` and loads nothing but tensors and plain values."""

    adapter_id = "torch_gprl.state"
    format_version = 1

    def save(
        self, component: Stateful, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> None:
        path.mkdir(parents=True)
        torch.save(component.state_dict(), path / "state.pt")

    def load(
        self,
        component: Stateful,
        path: Path,
        *,
        map_location: object,
        tensor_load_kwargs: Mapping[str, Any],
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> None:
        try:
            saved = torch.load(path / "state.pt", map_location="cpu", weights_only=True)
        except Exception as error:  # pickle and zip errors have no common class
            raise CheckpointError("the stored tensors are damaged or not plain") from error
        _compare(_tensors(saved), _tensors(component.state_dict()))
        component.load_state_dict(saved)


def _tensors(state: object, place: str = "") -> dict[str, Tensor]:
    """All tensors of a nested state by their place in it."""
    if isinstance(state, Tensor):
        return {place.removeprefix("."): state}
    if isinstance(state, Mapping):
        items = list(state.items())
    elif isinstance(state, list | tuple):
        items = list(enumerate(state))
    else:
        return {}
    return {name: tensor for key, item in items for name, tensor in _tensors(item, f"{place}.{key}").items()}


def _compare(saved: Mapping[str, Tensor], present: Mapping[str, Tensor]) -> None:
    """Refuse a state of another shape before it half overwrites this one.

    Tensors that are absent or empty here pass: some are made at the first step, as by optimisers.
    """
    for name, tensor in present.items():
        if tensor.numel() == 0:
            continue
        if name not in saved:
            raise CheckpointError(f"it lacks {name}")
        if saved[name].shape != tensor.shape:
            expected, came = list(tensor.shape), list(saved[name].shape)
            raise CheckpointError(f"{name} has shape {came}, this run needs {expected}")
