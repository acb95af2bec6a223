"""The random numbers of a batch of environments: a draw depends on its address alone.

The address is (seed, learner, environment, episode, step, block), so that the trajectory of one environment
depends neither on how many others run beside it, nor on the order or the threads they run in. Gymnasium's
tasks draw their starts from Gymnasium's own generators instead, one for each environment.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.philox import philox, unit

MASK64 = 0xFFFFFFFFFFFFFFFF
LEARNER_STRIDE = 65536  # seeds between learners where Gymnasium's generators are used
ENV_BITS = 16  # of a word that holds the environment's index below and the block above: 65,536 of each
START_BLOCK = 0  # where the draws of an episode's start begin, among the blocks of an address


class Streams:
    """The random numbers of a batch of environments, one stream per (learner, environment) pair.

    Args:
        seed: the key shared by all; learners differ by their index, not by their seed.
        learners: number of learners.
        num_envs: environments of each learner.
        first_learner: index of the first learner, so that learner i of a batch can be run alone.
    """

    def __init__(self, seed: int, learners: int, num_envs: int, first_learner: int = 0) -> None:
        if num_envs > LEARNER_STRIDE:
            raise ValueError(f"num_envs must be at most {LEARNER_STRIDE}, not {num_envs}; use more learners")
        self.key = seed & MASK64
        index = np.arange(learners * num_envs, dtype=np.uint64)
        self._env = index % np.uint64(num_envs)
        self._learner = index // np.uint64(num_envs) + np.uint64(first_learner)
        self.episode = np.zeros(learners * num_envs, dtype=np.uint64)
        self.generators: dict[int, np.random.Generator] = {}

    def generator(self, row: int) -> np.random.Generator:
        """Gymnasium's own generator for one environment: its seed is `seed + 65536 · learner + env`.

        It goes on from episode to episode, as Gymnasium's does when a reset gives no seed.
        """
        if row not in self.generators:
            seed = self.key + LEARNER_STRIDE * int(self._learner[row]) + int(self._env[row])
            self.generators[row] = np.random.default_rng(seed)
        return self.generators[row]

    def save(self) -> dict[str, Tensor]:
        """Where the streams stand, as copies."""
        states = np.zeros((len(self.generators), 3), dtype=np.uint64)
        for saved, (row, generator) in zip(states, self.generators.items(), strict=True):
            state = generator.bit_generator.state["state"]["state"]
            saved[:] = row, state >> 64, state & MASK64
        return {
            "seed": torch.from_numpy(np.array(self.key, dtype=np.uint64).view(np.int64)),
            "episode": torch.from_numpy(self.episode.astype(np.int64)),
            "generators": torch.from_numpy(states.view(np.int64)),
        }

    def load(self, saved: dict[str, Tensor]) -> None:
        """Go on from what `save` gave."""
        self.key = int(saved["seed"].numpy().view(np.uint64))
        self.episode[:] = saved["episode"].numpy().astype(np.uint64)
        self.generators.clear()
        for row, high, low in saved["generators"].numpy().view(np.uint64).tolist():
            bits = self.generator(row).bit_generator
            state = dict(bits.state)
            state["state"] = {**state["state"], "state": high << 64 | low}
            bits.state = state

    def uniform(
        self, rows: NDArray[np.intp], step: NDArray[np.uint64], size: int, block: int
    ) -> NDArray[np.float64]:
        """Numbers in [0, 1).

        Args:
            rows: [R] flat indices of the environments that draw.
            step: [R, *S] the step within the episode at which they draw.
            size: how many numbers each address draws.
            block: at which of the address's blocks of two numbers to begin.

        Returns:
            [R, *S, size] float64.
        """
        blocks = np.arange(block, block + (size + 1) // 2, dtype=np.uint64)
        spread = (slice(None),) + (None,) * step.ndim
        words = philox(
            self.key,
            [
                self._env[rows][spread] | blocks << np.uint64(ENV_BITS),
                self._learner[rows][spread],
                self.episode[rows][spread],
                step[..., None],
            ],
        )
        pairs = np.stack([unit(words[0], words[1]), unit(words[2], words[3])], axis=-1)
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

    @property
    def generators(self) -> list[np.random.Generator]:
        """Gymnasium's generators of the R environments, for tasks that draw as Gymnasium does."""
        return [self._streams.generator(row) for row in self._rows.tolist()]

    def uniform(self, low: float, high: float, size: int) -> NDArray[np.float64]:
        """[R, size] numbers uniform in [low, high)."""
        values = self._streams.uniform(self._rows, self._step, size, self._block)
        self._block += (size + 1) // 2
        return low + (high - low) * values

    def normal(self, std: float, size: int) -> NDArray[np.float64]:
        """[R, size] normal numbers of standard deviation `std`."""
        values = self._streams.normal(self._rows, self._step, size, self._block)
        self._block += (size + 1) // 2
        return std * values
