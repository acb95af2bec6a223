"""What the comparison of kernels reports: gains paired by seed, with their intervals."""

import math

import pytest

from benchmarks.graph_report import Score, paired_gain


def runs(kernel: str, errors: list[float]) -> list[Score]:
    rest = {"rmse_near": 1.0, "rmse_far": 1.0, "nlpd": 0.0, "tuning": 1.0, "learning": 1.0, "predicting": 1.0}
    return [Score("jump", kernel, 100, seed, error, **rest) for seed, error in enumerate(errors)]


def test_a_gain_is_paired_by_seed_against_the_kernel_that_is_best_on_average():
    found = {
        "Matérn 1/2": runs("Matérn 1/2", [0.5, 0.7, 0.9]),
        "Matérn 3/2": runs("Matérn 3/2", [0.1, 2.0, 2.0]),
        "successor": runs("successor", [0.4, 0.6, 0.7]),
    }
    gain = paired_gain(found, "successor", "rmse")
    assert gain.mean == pytest.approx(0.4 / 3)
    # t of 2 degrees of freedom times the standard error of 0.1, 0.1, 0.2
    assert gain.half == pytest.approx(4.302653 * math.sqrt(0.01 / 3) / math.sqrt(3), rel=1e-6)


def test_without_pairs_there_is_no_gain():
    alone = {"successor": runs("successor", [0.4, 0.6])}
    assert all(math.isnan(number) for number in paired_gain(alone, "successor", "rmse"))
    once = {"Matérn 1/2": runs("Matérn 1/2", [0.5]), "successor": runs("successor", [0.4])}
    gain = paired_gain(once, "successor", "rmse")
    assert gain.mean == pytest.approx(0.1)
    assert math.isnan(gain.half)
