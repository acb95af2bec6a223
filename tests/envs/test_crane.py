"""The crane against its equations and its rewards in closed form."""

import math

import numpy as np
import pytest

from tests.envs.trajectories import after_a_step, integrated, simulated

TROLLEY, LOAD, ROPE, GRAVITY = 1.0, 0.5, 0.8, 9.81


def rates(x, u):
    _, θ, speed, ω = x
    sine, cosine = math.sin(θ), math.cos(θ)
    d = TROLLEY + LOAD * sine**2
    pull = LOAD * ROPE * sine * ω**2
    return np.array(
        [
            speed,
            ω,
            (u[0] + LOAD * GRAVITY * sine * cosine + pull) / d,
            -((TROLLEY + LOAD) * GRAVITY * sine + u[0] * cosine + pull * cosine) / ROPE / d,
        ]
    )


def test_it_moves_as_the_equations_say_for_5_seconds_of_random_forces():
    rng = np.random.default_rng(0)
    for start in rng.uniform(-1, 1, (4, 4)):
        actions = rng.uniform(-10, 10, (100, 1))
        error = simulated("crane", start, actions) - integrated(rates, start, actions, 0.05)
        assert np.abs(error).max() < 1e-4


def test_the_reward_counts_distance_swing_speeds_and_effort():
    env, out = after_a_step("crane", [-0.5, 0.4, 0.3, -0.2], -4.0)
    (x, θ), (speed, ω) = env.qpos.flatten().tolist(), env.qvel.flatten().tolist()
    e = x + ROPE * math.sin(θ) - 1
    expected = -(e**2 + 0.5 * θ**2 + 0.1 * ω**2 + 0.05 * speed**2 + 0.001 * 16)
    assert out["reward"].item() == pytest.approx(expected, rel=1e-9)
    observed = [x - 1, math.cos(θ), math.sin(θ), speed, ω]
    assert out["observation"].flatten().tolist() == pytest.approx(observed, rel=1e-12)


def test_a_still_load_at_the_goal_is_the_best_there_is():
    assert after_a_step("crane", [1.0, 0, 0, 0], 0.0)[1]["reward"].item() == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize(
    ("start", "ends"),
    [([-1.59, 0, 0, 0], False), ([-1.61, 0, 0, 0], True), ([0, 1.5, 0, 0], False), ([0, -1.7, 0, -3], True)],
)
def test_an_episode_ends_off_the_rail_or_with_a_slack_rope(start, ends):
    assert after_a_step("crane", start, 0.0)[1]["terminated"].item() == ends


def test_free_motion_keeps_its_energy():
    x, θ, speed, ω = simulated("crane", np.array([0.0, 1.2, 0.3, 0.0]), np.zeros((100, 1))).T
    kinetic = 0.5 * (TROLLEY + LOAD) * speed**2 + LOAD * ROPE * speed * ω * np.cos(θ)
    kinetic += 0.5 * LOAD * (ROPE * ω) ** 2
    energy = kinetic - LOAD * GRAVITY * ROPE * np.cos(θ)
    assert np.ptp(θ) > 2
    assert np.ptp(x) > 0.05
    assert np.ptp(energy) < 1e-4
