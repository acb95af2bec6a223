"""Normal noise for every control step, computed ahead.

Counter-based numbers cost many small array operations whether one step or thirty are asked for, so each
environment keeps the noise of its next `AHEAD` steps.
"""

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from envs.philox import NOISE_BLOCK, Streams

AHEAD = 32  # steps


class StepNoise:
    """Standard normal vectors of `size` entries, one per environment and step.

    Args:
        streams: where the numbers come from.
        size: entries of each vector.
    """

    def __init__(self, streams: Streams, size: int) -> None:
        self._streams, self._size = streams, size
        copies = len(streams.episode)
        self._all = np.arange(copies)
        self._first = np.zeros(copies, dtype=np.int64)  # the step of each environment's first stored vector
        self._ahead = np.zeros((copies, AHEAD, size))

    def refill(self, rows: NDArray[np.intp], steps: NDArray[np.int64]) -> None:
        """Compute the vectors of the next steps of `rows` [R], from `steps` [R] on."""
        step = (steps[:, None] + np.arange(AHEAD)).astype(np.uint64)
        self._ahead[rows] = self._streams.normal(rows, step, self._size, NOISE_BLOCK)
        self._first[rows] = steps

    def at(self, steps: NDArray[np.int64]) -> Float[Tensor, "B size"]:
        """The vectors of all environments, each at its own step `steps` [B]."""
        offset = steps - self._first
        if offset.max() >= AHEAD:
            self.refill(self._all, steps)
            offset = np.zeros_like(steps)
        return torch.from_numpy(self._ahead[self._all, offset])
