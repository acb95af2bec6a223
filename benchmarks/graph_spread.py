"""What part of an error all seeds share, and what part comes and goes with the data.

With m_s the values that a kernel learns from the trajectories of seed s, and f the true ones, the mean over
seeds of the squared error is squared bias plus variance, at every state and so on average:

    E |m_s − f|² = |E m_s − f|² + E |m_s − E m_s|².

The variance is half of the mean |m_s − m_t|² over pairs of seeds, for any number of these. Intervals are
percentiles of a paired bootstrap over seeds (Efron and Tibshirani, 1993).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

RESAMPLES = 4000
TAIL = 0.025  # on each side of a 95 % interval

Inner = Float[np.ndarray, "seeds seeds"]  # mean over states of the product of the errors of two seeds


class Split(NamedTuple):
    """Mean squared error over seeds, in squared standard deviations of the value."""

    squared_bias: float
    variance: float


class Ratio(NamedTuple):
    """A variance in parts of another, and its 95 % interval."""

    value: float
    low: float
    high: float


def error_file(folder: Path, problem: str, kernel: str, seed: int) -> Path:
    """Where the errors of one kernel and seed are kept."""
    name = "".join(letter if letter.isalnum() else "_" for letter in f"{problem} {kernel} {seed}")
    return folder / "errors" / f"{name}.pt"


def keep_errors(path: Path, errors: dict[int, Float[Tensor, " states"]]) -> None:
    """Write the errors at all states, by budget."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({budget: error.float() for budget, error in errors.items()}, path)


def inner_products(paths: list[Path], budget: int) -> Inner:
    """What the errors of the seeds in these files have in common at one budget."""
    errors = torch.stack([torch.load(path, weights_only=True)[budget] for path in paths]).double()
    return (errors @ errors.mT / errors.shape[-1]).numpy()


def split(inner: Inner) -> Split:
    """Squared bias and variance, neither of which the number of seeds biases; it must be 2 at least."""
    bias, variance = _split(inner, np.ones((1, len(inner))))
    return Split(bias.item(), variance.item())


def variance_ratio(inner: Inner, other: Inner) -> Ratio:
    """Variance in parts of another kernel's on the same seeds."""
    seeds = len(inner)
    counts = np.random.default_rng(0).multinomial(seeds, np.full(seeds, 1 / seeds), size=RESAMPLES)
    counts = counts[(counts > 0).sum(-1) > 1]  # one seed alone has no variance
    ratios = _split(inner, counts)[1] / _split(other, counts)[1]
    low, high = np.quantile(ratios, [TAIL, 1 - TAIL])
    return Ratio(split(inner).variance / split(other).variance, float(low), float(high))


def _split(inner: Inner, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of seeds that count so often [resamples, seeds]; a seed is not paired with itself."""
    square = counts @ inner.diagonal() / len(inner)
    apart = (inner.diagonal()[:, None] + inner.diagonal()) / 2 - inner  # half of |m_s − m_t|²
    pairs = len(inner) ** 2 - (counts**2).sum(-1)
    variance = np.einsum("rs,st,rt->r", counts, apart, counts) / pairs
    return square - variance, variance
