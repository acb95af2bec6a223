"""Streams of random numbers: their distributions, and independence of who else draws."""

import numpy as np
import pytest
from scipy import stats

from envs.streams import StartDraws, Streams


def draws(streams: Streams, rows: list[int], kind: str, size: int = 4) -> np.ndarray:
    steps = np.arange(50, dtype=np.uint64) * np.ones((len(rows), 1), dtype=np.uint64)
    return getattr(streams, kind)(np.array(rows), steps, size, 0)


def test_uniform_and_normal_numbers_are_so_distributed():
    # Kolmogorov and Smirnov at level 1e-4 each, on 40,000 numbers of one fixed seed.
    streams = Streams(seed=7, learners=2, num_envs=100)
    assert stats.kstest(draws(streams, range(200), "uniform").ravel(), "uniform").pvalue > 1e-4
    assert stats.kstest(draws(streams, range(200), "normal").ravel(), "norm").pvalue > 1e-4


def test_neighbouring_addresses_are_uncorrelated():
    # Each correlation of n pairs has standard deviation 1/√n; 4.5 of them are crossed in 1 of 150,000 tests.
    numbers = draws(Streams(seed=3, learners=2, num_envs=100), range(200), "normal", size=2)
    for axis in range(3):
        first = np.take(numbers, range(numbers.shape[axis] - 1), axis).ravel()
        second = np.take(numbers, range(1, numbers.shape[axis]), axis).ravel()
        assert abs(np.corrcoef(first, second)[0, 1]) < 4.5 / np.sqrt(first.size)


def test_a_pair_of_learner_and_environment_draws_the_same_in_any_batch():
    many = Streams(seed=5, learners=3, num_envs=8)
    few = Streams(seed=5, learners=1, num_envs=2, first_learner=2)
    np.testing.assert_array_equal(draws(many, [2 * 8 + 1], "normal"), draws(few, [1], "normal"))
    assert (draws(many, [2 * 8 + 1], "normal") != draws(many, [8 + 1], "normal")).all()


def test_seeds_and_episodes_change_every_number():
    streams = Streams(seed=5, learners=1, num_envs=1)
    first = draws(streams, [0], "uniform")
    streams.episode += np.uint64(1)
    assert (draws(streams, [0], "uniform") != first).all()
    assert (draws(Streams(seed=6, learners=1, num_envs=1), [0], "uniform") != first).all()


def test_successive_start_draws_are_fresh_and_in_range():
    source = StartDraws(Streams(seed=0, learners=1, num_envs=500), np.arange(500))
    first, second = source.uniform(-2.0, 3.0, 3), source.uniform(-2.0, 3.0, 3)
    assert first.shape == (500, 3)
    assert (first != second).all()
    assert -2.0 <= first.min() < -1.9
    assert 2.9 < first.max() < 3.0


def test_more_environments_than_seeds_between_learners_are_refused():
    with pytest.raises(ValueError, match="at most 65536, not 70000"):
        Streams(seed=0, learners=1, num_envs=70_000)
