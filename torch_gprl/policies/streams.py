"""Random numbers by learner: what learner i draws does not depend on how many others learn beside it."""

import copy
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

# keeps the seeds of (seed, learner) pairs apart; a prime above any count of learners
LEARNER_STRIDE = 1_000_003
PURPOSES = ("weights", "exploration")  # or a learner's exploration would repeat the numbers of its weights


def learner_generators(
    seed: int, learners: Sequence[int], purpose: Literal["weights", "exploration"]
) -> list[torch.Generator]:
    """One CPU generator for each learner index, seeded by (seed, learner, purpose)."""
    numbers = [seed * LEARNER_STRIDE + index for index in learners]
    offset = PURPOSES.index(purpose)
    return [torch.Generator().manual_seed(len(PURPOSES) * number + offset) for number in numbers]


def stacked_normal(generators: Sequence[torch.Generator], shape: Sequence[int]) -> Tensor:
    """Standard normal numbers [len(generators), *shape], row i from generator i."""
    return torch.stack([torch.randn(tuple(shape), generator=generator) for generator in generators])


class NoiseStream:
    """Standard normal noise for a policy, drawn a block of steps at a time from one generator per learner.

    A block costs one call per learner, a step costs an index. `state()` and `restore()` continue a stream
    exactly where it stood.
    """

    BLOCK = 64  # steps drawn at once

    def __init__(self, seed: int, learners: Sequence[int]) -> None:
        self._generators = learner_generators(seed, learners, "exploration")
        self._block: Tensor | None = None
        self._next = 0

    def __len__(self) -> int:
        """Number of learners."""
        return len(self._generators)

    def draw(self, like: Tensor) -> Tensor:
        """Noise in the shape, dtype and on the device of `like` [learners, ...]."""
        if self._block is None or self._next == self.BLOCK or self._block.shape[2:] != like.shape[1:]:
            self._block = stacked_normal(self._generators, (self.BLOCK, *like.shape[1:])).to(like)
            self._next = 0
        noise = self._block[:, self._next]
        self._next += 1
        return noise.to(like)  # a restored block comes from the CPU

    def split(self, count: int) -> list["NoiseStream"]:
        """Streams for `count` copies of a policy, seeded from this one, which moves on."""
        parts: list[NoiseStream] = [copy.copy(self) for _ in range(count)]
        for part in parts:
            seeds = [torch.randint(2**62, (), generator=generator) for generator in self._generators]
            part._generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
            part._block = None
        return parts

    def state(self) -> dict[str, Tensor]:
        """Tensors that `restore` takes."""
        block = torch.zeros(0) if self._block is None else self._block.cpu()
        states = torch.stack([generator.get_state() for generator in self._generators])
        return {"generators": states, "block": block, "next": torch.tensor(self._next)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue where the stream stood when `state` was taken."""
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.set_state(saved.clone())  # it does not take views
        self._block = state["block"] if state["block"].numel() else None
        self._next = int(state["next"])
