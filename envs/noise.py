"""Normal noise for every control step, computed ahead.

Counter-based numbers cost many small array operations whether one step or thirty are asked for, so the noise
of the next `AHEAD` steps of all environments is kept, and a step only moves on to the next slice of it.
"""

import numpy as np
from numpy.typing import NDArray

from envs.streams import Streams

AHEAD = 32  # steps


class StepNoise:
    """Normal vectors for environments that all step together but began their episodes at different times.

    Args:
        streams: where the numbers come from.
        std: standard deviation of every entry.
        size: entries of an environment's vector.
        block: the block of each step's address at which the numbers begin.

    Attributes:
        now: [B, size] the noise of the present step, float64.
    """

    def __init__(self, streams: Streams, std: float, size: int, block: int) -> None:
        self._streams, self._std, self._block = streams, std, block
        self._all = np.arange(len(streams.episode))
        self._ahead = np.zeros((AHEAD, len(self._all), size))
        self._slot = AHEAD - 1
        self.now = self._ahead[self._slot]

    def start(self, rows: NDArray[np.intp]) -> None:
        """Environments `rows` [R] begin a new episode: they are at step 0 of it now."""
        steps = np.zeros(len(rows), dtype=np.int64)
        if len(rows) == len(self._all):
            self.resume(steps)
        else:
            self._fill(rows, steps)

    def advance(self, steps: NDArray[np.int64]) -> None:
        """All environments have moved to the next step; `steps` [B] is where each is in its episode."""
        self._slot += 1
        if self._slot == AHEAD:
            self.resume(steps)
        self.now = self._ahead[self._slot]

    def resume(self, steps: NDArray[np.int64]) -> None:
        """All environments are at `steps` [B] of their episodes, wherever they were before."""
        self._slot = 0
        self._fill(self._all, steps)
        self.now = self._ahead[0]

    def _fill(self, rows: NDArray[np.intp], steps: NDArray[np.int64]) -> None:
        """Compute the vectors of `rows` from the present slot to the last."""
        step = (steps[:, None] + np.arange(AHEAD - self._slot)).astype(np.uint64)
        values = self._streams.normal(rows, step, self._ahead.shape[-1], self._block)
        self._ahead[self._slot :, rows] = (self._std * values).swapaxes(0, 1)
