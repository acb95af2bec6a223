"""The cart-pole against its equations and its rewards in closed form."""

import math

import numpy as np
import pytest

from tests.envs.trajectories import after_a_step, integrated, simulated

CART, POLE, HALF, GRAVITY = 1.0, 0.1, 0.5, 9.81


def rates(x, u):
    _, θ, speed, ω = x
    sine, cosine = math.sin(θ), math.cos(θ)
    d = 4 * CART + POLE + 3 * POLE * sine**2
    return np.array(
        [
            speed,
            ω,
            (4 * u[0] - 3 * POLE * GRAVITY * sine * cosine + 4 * POLE * HALF * sine * ω**2) / d,
            3 * ((CART + POLE) * GRAVITY * sine - cosine * (u[0] + POLE * HALF * sine * ω**2)) / HALF / d,
        ]
    )


@pytest.mark.parametrize(("task", "step"), [("cartpole-balance", 0.02), ("cartpole-swingup", 0.04)])
def test_it_moves_as_the_equations_say_for_5_seconds_of_random_forces(task, step):
    rng = np.random.default_rng(0)
    for start in rng.uniform([-1, -3, -1, -3], [1, 3, 1, 3], (3, 4)):
        actions = rng.uniform(-10, 10, (round(5 / step), 1))
        error = simulated(task, start, actions) - integrated(rates, start, actions, step)
        assert np.abs(error).max() < 1e-4


def test_swinging_up_rewards_a_tip_above_the_middle_less_effort():
    env, out = after_a_step("cartpole-swingup", [0.1, 0.2, 0.0, 0.0], 5.0)
    x, θ = env.qpos.flatten().tolist()
    tip = math.exp(-0.5 * ((x + math.sin(θ)) ** 2 + (math.cos(θ) - 1) ** 2) / 0.25**2)
    assert out["info", "tip"].item() == pytest.approx(tip, rel=1e-9)
    assert out["reward"].item() == pytest.approx(tip - 0.00025, rel=1e-9)


def test_balancing_earns_one_for_each_step():
    assert after_a_step("cartpole-balance", [0.1, 0.05, 0.0, 0.0], 5.0)[1]["reward"].item() == 1


@pytest.mark.parametrize(
    ("task", "start", "ends"),
    [
        ("cartpole-balance", [2.39, 0, 0, 0], False),
        ("cartpole-balance", [-2.41, 0, 0, 0], True),
        ("cartpole-balance", [0, math.radians(11.9), 0, 0], False),
        ("cartpole-balance", [0, math.radians(-12.1), 0, 0], True),
        ("cartpole-swingup", [0, math.pi, 0, 0], False),
        ("cartpole-swingup", [2.41, math.pi, 0, 0], True),
    ],
)
def test_an_episode_ends_off_the_rail_or_fallen(task, start, ends):
    assert after_a_step(task, start, 0.0)[1]["terminated"].item() == ends


def test_free_motion_keeps_its_energy():
    x, θ, speed, ω = simulated("cartpole-swingup", np.array([0.0, 1.5, 0.3, 1.0]), np.zeros((125, 1))).T
    moment = POLE * HALF
    kinetic = 0.5 * (CART + POLE) * speed**2 + moment * speed * ω * np.cos(θ) + 2 / 3 * moment * HALF * ω**2
    energy = kinetic + moment * GRAVITY * np.cos(θ)
    assert np.ptp(θ) > 2
    assert np.ptp(x) > 0.05
    assert np.ptp(energy) < 1e-5
