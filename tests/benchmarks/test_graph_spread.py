"""Squared bias and variance over seeds: the usual estimates, and what scaling does to them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.graph_spread import error_file, inner_products, keep_errors, split, variance_ratio

BUDGET = 100


def kept(folder: Path, errors: torch.Tensor, kernel: str) -> np.ndarray:
    paths = [error_file(folder, "jump", kernel, seed) for seed in range(len(errors))]
    for path, error in zip(paths, errors, strict=True):
        keep_errors(path, {BUDGET: error, 2 * BUDGET: torch.zeros_like(error)})
    return inner_products(paths, BUDGET)


def test_bias_and_variance_are_the_unbiased_estimates_at_every_state(tmp_path: Path):
    errors = torch.randn(6, 40) + torch.randn(40)
    found = split(kept(tmp_path, errors, "Matérn 1/2"))
    variance = errors.var(0).mean()  # ddof 1
    assert found.variance == pytest.approx(float(variance), rel=1e-5)
    assert found.squared_bias == pytest.approx(float(errors.mean(0).square().mean() - variance / 6), rel=1e-4)
    assert sum(found) == pytest.approx(float(errors.square().mean()), rel=1e-5)


def test_a_variance_in_parts_of_another_is_paired_by_seed(tmp_path: Path):
    errors = torch.randn(8, 200)
    one, other = kept(tmp_path, errors, "one"), kept(tmp_path, 2 * errors + 3, "other")
    assert variance_ratio(one, other) == pytest.approx((0.25, 0.25, 0.25), rel=1e-4)


def test_three_seeds_are_enough_for_an_interval(tmp_path: Path):
    one, other = (kept(tmp_path, torch.randn(3, 40), name) for name in ("one", "other"))
    assert np.isfinite(variance_ratio(one, other)).all()


def test_intervals_of_a_ratio_cover_the_truth_as_often_as_they_say(tmp_path: Path):
    """Twenty seeds, true ratio 1.5: of 50 intervals 47.5 cover it on average, 41 or more with 99.9 %."""
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(50):
        loud, calm = (level * rng.standard_normal((20, 12)) for level in (np.sqrt(1.5), 1.0))
        ratio = variance_ratio(loud @ loud.T, calm @ calm.T)
        covered += ratio.low <= 1.5 <= ratio.high
    assert covered >= 41
