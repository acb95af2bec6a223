"""The bootstrap interval: known widths, known coverage."""

import numpy as np
import pytest

from torch_gprl.runs import bootstrap_interval


def test_it_has_the_normal_theory_width_for_many_values():
    values = np.random.default_rng(1).normal(3.0, 2.0, size=4000)
    low, high = bootstrap_interval(values)
    standard_error = values.std() / np.sqrt(values.size)
    assert (high - low) == pytest.approx(2 * 1.96 * standard_error, rel=0.06)
    assert (high + low) / 2 == pytest.approx(values.mean(), abs=0.1 * standard_error)


def test_it_covers_the_mean_as_often_as_it_says():
    """2,000 intervals over 20 normal values; a percentile bootstrap of so few covers about 92.5 %.

    The bounds are five standard errors (0.6 %) away: a false alarm in a million.
    """
    values = np.random.default_rng(2).normal(size=(2000, 20))
    low, high = bootstrap_interval(values)
    coverage = np.mean((low <= 0) & (high >= 0))
    assert 0.895 < coverage < 0.96


def test_equal_values_leave_no_doubt():
    low, high = bootstrap_interval(np.full((2, 7), 4.0))
    assert low == pytest.approx(4.0)
    assert high == pytest.approx(4.0)


def test_it_is_the_same_every_time():
    values = np.random.default_rng(3).normal(size=9)
    assert bootstrap_interval(values) == bootstrap_interval(values)


def test_it_moves_and_grows_with_the_values():
    values = np.random.default_rng(4).normal(size=8)
    low, high = bootstrap_interval(values)
    moved = bootstrap_interval(5 - 3 * values)
    assert moved == pytest.approx((5 - 3 * high, 5 - 3 * low), abs=0.15)
