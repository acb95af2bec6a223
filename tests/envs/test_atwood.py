"""The swinging Atwood's machine: its equations, its constants of motion and its known orbits."""

import math

import mujoco
import numpy as np
import pytest

from envs import atwood
from envs.models import stripped
from envs.physics import MujocoPhysics
from tests.envs.trajectories import after_a_step, integrated, simulated

BOB, COUNTERWEIGHT, GRAVITY = 1.0, 2.0, 9.81


def rates(x, u):
    θ, r, ω, speed = x
    return np.array(
        [
            ω,
            speed,
            (-GRAVITY * math.sin(θ) - 2 * speed * ω) / r,
            (BOB * r * ω**2 + BOB * GRAVITY * math.cos(θ) - COUNTERWEIGHT * GRAVITY - u[0])
            / (BOB + COUNTERWEIGHT),
        ]
    )


def machine(ratio: float) -> MujocoPhysics:
    """The machine with another counterweight, M = ratio · m, in fine steps of 2 ms."""
    model = stripped(atwood.MODEL)
    model.dof_armature[1] = ratio
    model.actuator_biasprm[0, 0] = -ratio * GRAVITY
    model.opt.timestep = 0.002
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return MujocoPhysics(model, copies=1, substeps=1, threads=1)


def motion(ratio: float, start: list[float], seconds: float) -> np.ndarray:
    """(θ, r, θ̇, ṙ) every 2 ms of free motion, [T + 1, 4]."""
    physics = machine(ratio)
    physics.place(np.arange(1), np.array([start[:2]]), np.array([start[2:]]))
    states = [np.array(start)]
    for _ in range(round(seconds / 0.002)):
        physics.advance()
        states.append(np.concatenate([physics.qpos[0], physics.qvel[0]]))
    return np.stack(states)


def test_it_moves_as_the_equations_say_for_5_seconds_of_random_forces():
    rng = np.random.default_rng(1)
    compared = 0
    for _ in range(6):
        start = np.array([rng.uniform(-1, 1), rng.uniform(0.8, 1.2), rng.uniform(-1, 1), 0])
        actions = np.clip(rng.normal(-8, 4, (100, 1)), -10, 10)
        states = simulated("atwood", start, actions)
        outside = np.flatnonzero((states[:, 1] < 0.3) | (states[:, 1] > 3))
        steps = outside[0] - 1 if outside.size else 100
        expected = integrated(rates, start, actions[:steps], 0.05)
        assert np.abs(states[: steps + 1] - expected).max() < 1e-4
        compared += steps
    assert compared > 200


def test_a_pull_that_makes_up_for_the_heavier_side_keeps_the_machine_still():
    states = simulated("atwood", np.array([0, 1.0, 0, 0]), np.full((100, 1), (BOB - COUNTERWEIGHT) * GRAVITY))
    np.testing.assert_allclose(states, np.tile([0, 1.0, 0, 0], (101, 1)), atol=1e-12)


def test_free_motion_keeps_its_energy():
    θ, r, ω, speed = motion(COUNTERWEIGHT, [2.0, 1.0, 4.0, 0.0], 5.0).T
    kinetic = 0.5 * (BOB + COUNTERWEIGHT) * speed**2 + 0.5 * BOB * (r * ω) ** 2
    energy = kinetic + GRAVITY * r * (COUNTERWEIGHT - BOB * np.cos(θ))
    assert r.min() > 0.3
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)


def test_the_machine_of_mass_ratio_3_has_a_second_constant_of_motion():
    """Tufillaro, Am. J. Phys. 54, 1986: the only integrable ratio."""
    θ, r, ω, speed = motion(3.0, [1.5, 1.0, 0.0, 0.0], 5.0).T
    half, rate = np.sin(θ / 2), np.cos(θ / 2)
    # I = r² θ̇ (ṙ cos(θ/2) − ½ r θ̇ sin(θ/2)) + g r² sin(θ/2) cos²(θ/2)
    integral = r**2 * ω * (speed * rate - 0.5 * r * ω * half) + GRAVITY * r**2 * half * rate**2
    np.testing.assert_allclose(integral, integral[0], rtol=1e-6)


def test_the_smile_orbit_closes():
    """M/m = 1.66534, released at rest at a right angle (Tufillaro et al. 1984): swings from side to side."""
    states = motion(1.66534, [math.pi / 2, 1.0, 0.0, 0.0], 2.0)
    speed = np.abs(states[:, 2:]).sum(axis=1)
    # At the far end the bob rests, mirrored, and after twice the time it rests where it began; to the grid's
    # 2 ms, within which it moves by ½ g t² < 2e-5.
    for turn, (time, side) in enumerate([(0.92, -1), (1.84, 1)]):
        around = round(time / 0.002) + np.arange(-50, 50)
        there = around[speed[around].argmin()]
        assert speed[there] < 0.02, f"does not rest at turn {turn}"
        np.testing.assert_allclose(states[there, :2], [side * math.pi / 2, 1.0], atol=2e-5)


def test_swinging_rewards_the_energy_the_length_and_little_effort():
    env, out = after_a_step("atwood", [0.6, 1.1, 0.4, 0.2], 2.0)
    (θ, r), ω = env.qpos.flatten().tolist(), env.qvel.flatten()[0].item()
    energy = 0.5 * (r * ω) ** 2 + GRAVITY * r * (1 - math.cos(θ))
    swing = math.exp(-((energy / (GRAVITY / 2) - 1) ** 2))
    assert out["info", "swing"].item() == pytest.approx(swing, rel=1e-9)
    assert out["reward"].item() == pytest.approx(swing - 0.5 * (r - 1) ** 2 - 0.004, rel=1e-9)


def test_settling_rewards_length_one_and_no_swing():
    env, out = after_a_step("atwood-settle", [0.6, 1.1, 0.4, 0.2], 2.0)
    θ, r = env.qpos.flatten().tolist()
    expected = math.exp(-((r - 1) ** 2) / (2 * 0.3**2) - θ**2 / (2 * 0.5**2))
    assert out["reward"].item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("length", "speed", "ends"), [(0.32, 0, False), (0.32, -2, True), (2.9, 4, True)])
def test_an_episode_ends_where_the_rope_is_too_short_or_too_long(length, speed, ends):
    assert after_a_step("atwood", [0, length, 0, speed], -10.0)[1]["terminated"].item() == ends
