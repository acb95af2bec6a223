"""Counter-based random numbers: a draw depends on its address alone.

The address of a draw is (seed, learner, environment, episode, step, block), so that the trajectory of one
environment depends neither on how many others run beside it, nor on the order or the threads they run in.
The generator is Philox 4x32 with ten rounds (Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy
as 1, 2, 3", SC 2011), a bijection of 128-bit counters under a 64-bit key that passes BigCrush.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
WEYL = (0x9E3779B9, 0xBB67AE85)  # the key's increments: golden ratio and √3 − 1, in 32 bits
ROUNDS = 10
LOW_WORD = np.uint64(0xFFFFFFFF)
WORD_BITS = np.uint64(32)

BLOCK_BITS = 8  # a step owns 2⁸ blocks of four words; 24 bits remain for the step
START_BLOCK = 0  # where the draws of an episode's start begin


def philox(key: int, counter: Sequence[NDArray[np.uint64]]) -> list[NDArray[np.uint64]]:
    """Encrypt 128-bit counters with a 64-bit key.

    Args:
        key: the 64-bit key; higher bits are dropped.
        counter: four 32-bit words, least significant first, each in the low half of a uint64 array; the four
            shapes broadcast.

    Returns:
        Four 32-bit words of random bits, in the low half of uint64 arrays.
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key & 0xFFFFFFFF, (key >> 32) & 0xFFFFFFFF
    for _ in range(ROUNDS):
        p0, p1 = MULTIPLIERS[0] * c0, MULTIPLIERS[1] * c2
        c0, c1, c2, c3 = (
            (p1 >> WORD_BITS) ^ c1 ^ np.uint64(k0),
            p1 & LOW_WORD,
            (p0 >> WORD_BITS) ^ c3 ^ np.uint64(k1),
            p0 & LOW_WORD,
        )
        k0, k1 = (k0 + WEYL[0]) & 0xFFFFFFFF, (k1 + WEYL[1]) & 0xFFFFFFFF
    return [c0, c1, c2, c3]


def _unit(high: NDArray[np.uint64], low: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Two words as a number of 53 bits in [0, 1)."""
    bits = (high >> np.uint64(5) << np.uint64(26)) | (low >> np.uint64(6))
    return bits.astype(np.float64) * 2.0**-53


class Streams:
    """The random numbers of a batch of environments, one stream per (learner, environment) pair.

    Args:
        seed: the key shared by all; learners differ by their index, not by their seed.
        learners: number of learners.
        num_envs: environments of each learner.
        first_learner: index of the first learner, so that learner i of a batch can be run alone.
    """

    def __init__(self, seed: int, learners: int, num_envs: int, first_learner: int = 0) -> None:
        self.key = seed & 0xFFFFFFFFFFFFFFFF
        index = np.arange(learners * num_envs, dtype=np.uint64)
        self._env = index % np.uint64(num_envs)
        self._learner = index // np.uint64(num_envs) + np.uint64(first_learner)
        self.episode = np.zeros(learners * num_envs, dtype=np.uint64)

    def uniform(
        self, rows: NDArray[np.intp], step: NDArray[np.uint64], size: int, block: int
    ) -> NDArray[np.float64]:
        """Numbers in [0, 1).

        Args:
            rows: [R] flat indices of the environments that draw.
            step: [R, *S] the step within the episode at which they draw.
            size: how many numbers each address draws.
            block: where in the step's 256 blocks of two numbers to begin.

        Returns:
            [R, *S, size] float64.
        """
        blocks = np.arange(block, block + (size + 1) // 2, dtype=np.uint64)
        spread = (slice(None),) + (None,) * step.ndim
        words = philox(
            self.key,
            [
                self._env[rows][spread],
                self._learner[rows][spread],
                self.episode[rows][spread],
                (step[..., None] << np.uint64(BLOCK_BITS)) | blocks,
            ],
        )
        pairs = np.stack([_unit(words[0], words[1]), _unit(words[2], words[3])], axis=-1)
        return pairs.reshape(*step.shape, -1)[..., :size]

    def normal(
        self, rows: NDArray[np.intp], step: NDArray[np.uint64], size: int, block: int
    ) -> NDArray[np.float64]:
        """Standard normal numbers by Box and Muller's transform; arguments and shape as `uniform`."""
        pairs = self.uniform(rows, step, size + size % 2, block)
        radius = np.sqrt(-2.0 * np.log1p(-pairs[..., 0::2]))
        angle = 2.0 * math.pi * pairs[..., 1::2]
        normals = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        return normals.reshape(*step.shape, -1)[..., :size]


class StartDraws:
    """What a task draws from when episodes start: numbers for the R environments that are reset.

    Each call takes fresh numbers, so the order of the calls is part of a task's definition.
    """

    def __init__(self, streams: Streams, rows: NDArray[np.intp]) -> None:
        self._streams, self._rows = streams, rows
        self._step = np.zeros(len(rows), dtype=np.uint64)
        self._block = START_BLOCK

    def __len__(self) -> int:
        return len(self._rows)

    def uniform(self, low: float, high: float, size: int) -> Tensor:
        """[R, size] numbers uniform in [low, high), float64."""
        unit = self._streams.uniform(self._rows, self._step, size, self._block)
        self._block += (size + 1) // 2
        return torch.from_numpy(low + (high - low) * unit)

    def normal(self, std: float, size: int) -> Tensor:
        """[R, size] normal numbers of standard deviation `std`, float64."""
        unit = self._streams.normal(self._rows, self._step, size, self._block)
        self._block += (size + 1) // 2
        return torch.from_numpy(std * unit)
