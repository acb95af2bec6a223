"""The soak test can tell a leak from a start, and runs."""

import numpy as np
import pytest

from benchmarks.soak import Options, growth, soak


def test_what_fills_up_at_first_is_no_leak():
    frames = list(range(0, 1000, 10))
    memory = [100.0 + 50.0 * (step >= 50) for step in frames]
    assert growth(frames, memory) == pytest.approx(0.0, abs=1e-9)


def test_a_leak_shows_through_the_noise():
    frames = list(range(0, 1000, 10))
    noise = np.random.default_rng(0).normal(0, 1.0, len(frames))
    memory = [100.0 + 0.04 * step + tremor for step, tremor in zip(frames, noise, strict=True)]
    assert growth(frames, memory) == pytest.approx(0.04 * 890, abs=3.0)  # three standard errors


def test_a_short_run_is_measured():
    found = soak(Options(frames=4_000, learners=1, num_envs=5))
    assert found["frames"] == 4_000
    assert found["finite"]
    assert all(100 < mib < 10_000 for mib in found["memory_mib"].values())
