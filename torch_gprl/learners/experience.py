"""What was experienced: transitions of all learners side by side, in memory or in files.

TorchRL's replay buffer, kept whole in a saved state. Files only take the place of memory while a run is
going: a resumed run writes them anew, so that nothing that happens to them in between reaches its learner.
"""

import os
import shutil
from pathlib import Path
from typing import Any

from jaxtyping import Int
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer


class Experience:
    """The newest transitions of each learner; the oldest give way once there are as many as it holds.

    Args:
        capacity: most transitions of each learner.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._folder: Path | None = None
        self._buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity))

    def __len__(self) -> int:
        """Transitions of each learner."""
        return len(self._buffer)

    def extend(self, transitions: TensorDictBase) -> Int[Tensor, " N"]:
        """Add transitions [learners, N], the same entries each time; where they stand in `all`.

        Raises:
            OSError: the disk has no room for the files.
        """
        first = not len(self)
        rows = self._buffer.extend(transitions.transpose(0, 1))
        if first and self._folder is not None:
            _reserve(self._folder)
        return rows

    def all(self) -> TensorDictBase:
        """The transitions [learners, N], oldest first until some have given way."""
        stored = self._buffer[:]
        assert isinstance(stored, TensorDictBase)
        return stored.transpose(0, 1)

    def keep_in(self, folder: Path) -> None:
        """Move to memory-mapped files of a folder, which is emptied first.

        Other programs read them by `TensorDict.load_memmap(folder)`; rows that are not in use are zero.

        Raises:
            OSError: the folder cannot be emptied, or the disk has no room for the files.
        """
        state = self.state_dict()
        if folder.exists():
            shutil.rmtree(folder)
        self._folder = folder
        self._buffer = TensorDictReplayBuffer(
            storage=LazyMemmapStorage(self.capacity, scratch_dir=folder, existsok=True)
        )
        self.load_state_dict(state)

    def state_dict(self) -> dict[str, Any]:
        """The transitions themselves: tensors and plain numbers, whatever they lie in."""
        if not len(self):
            return {}
        return {"transitions": self.all().clone().to_dict(), "place": self._buffer.writer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self._buffer.empty()
        if state:
            self.extend(TensorDict(state["transitions"]).auto_batch_size_(2))
            self._buffer.writer.load_state_dict(state["place"])


def _reserve(folder: Path) -> None:
    """Claim the files' room on the disk: a memory-mapped page without it would end the process unheard."""
    if not hasattr(os, "posix_fallocate"):  # macOS and Windows have no such call
        return
    for path in folder.rglob("*.memmap"):
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
