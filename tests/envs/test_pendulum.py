"""The pendulum against its equation, its energy and its rewards in closed form."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import simpson

import envs
from tests.envs.trajectories import integrated, simulated

GRAVITY, FRICTION = 9.81, 0.05


def rates(x, u):
    return np.array([x[1], GRAVITY * math.sin(x[0]) - FRICTION * x[1] + u[0]])


def one_step(task: str, θ: float, ω: float, u: float):
    """The state and the output after one step from (θ, ω)."""
    env = envs.make(task, velocity_noise=0.0, dtype=torch.float64, info=True)
    data = env.place(
        torch.full((1, 1, 1), θ, dtype=torch.float64), torch.full((1, 1, 1), ω, dtype=torch.float64)
    )
    data["action"] = torch.full((1, 1, 1), u, dtype=torch.float64)
    out = env.step(data)["next"]
    return env.qpos.item(), env.qvel.item(), out


def test_it_moves_as_the_equation_says_for_5_seconds_of_random_torques():
    rng = np.random.default_rng(0)
    for start in rng.uniform([-3, -4], [3, 4], (4, 2)):
        actions = rng.uniform(-5, 5, (100, 1))
        error = simulated("pendulum-swingup", start, actions) - integrated(rates, start, actions, 0.05)
        assert np.abs(error).max() < 1e-4


def test_the_reward_of_swinging_up_is_height_less_effort():
    θ, _, out = one_step("pendulum-swingup", 2.0, -1.0, 3.0)
    assert out["info", "upright"].item() == pytest.approx((1 + math.cos(θ)) / 2, rel=1e-12)
    assert out["info", "effort"].item() == pytest.approx(-0.009, rel=1e-12)
    assert out["reward"].item() == pytest.approx((1 + math.cos(θ)) / 2 - 0.009, rel=1e-12)


@pytest.mark.parametrize(("task", "width"), [("pendulum-balance", 0.3), ("pendulum-explore", 0.5)])
@pytest.mark.parametrize("turns", [0, 1, -3])
def test_the_bell_reward_depends_on_the_angle_modulo_full_turns(task, width, turns):
    θ, ω, out = one_step(task, 0.3 + 2 * math.pi * turns, 0.5, -5.0)
    expected = math.exp(-((θ - 2 * math.pi * turns) ** 2) / (2 * width**2) - ω**2 / 8)
    assert out["reward"].item() == pytest.approx(expected, rel=1e-9)


def test_the_observation_is_cosine_sine_and_velocity():
    θ, ω, out = one_step("pendulum-swingup", 4.0, 2.0, 1.0)
    assert out["observation"].flatten().tolist() == pytest.approx([math.cos(θ), math.sin(θ), ω], abs=1e-12)


@pytest.mark.parametrize("side", [-1, 1])
def test_balancing_fails_beyond_a_quarter_turn_of_pi(side):
    inside, outside = (one_step("pendulum-balance", side * θ, 0.0, 0.0) for θ in (0.75, 0.79))
    assert abs(inside[0]) < math.pi / 4 < abs(outside[0])
    assert not inside[2]["terminated"].item()
    assert outside[2]["terminated"].item()


def test_torques_beyond_the_motor_act_as_the_strongest():
    assert one_step("pendulum-swingup", 2.0, 0.0, 50.0)[:2] == one_step("pendulum-swingup", 2.0, 0.0, 5.0)[:2]


def test_starts_are_as_documented():
    # 4,000 starts; bounds at 5 standard errors.
    θ = envs.make("pendulum-swingup", num_envs=4000, threads=1)
    θ.reset()
    assert θ.qpos.mean().item() == pytest.approx(math.pi, abs=5 * 0.1 / math.sqrt(4000))
    assert θ.qpos.std().item() == pytest.approx(0.1, rel=5 / math.sqrt(8000))
    assert not θ.qvel.any()
    balance = envs.make("pendulum-balance", num_envs=4000, threads=1)
    balance.reset()
    for values in (balance.qpos, balance.qvel):
        assert values.abs().max().item() == pytest.approx(0.2, abs=0.001)
        assert values.mean().item() == pytest.approx(0, abs=5 * 0.2 / math.sqrt(3 * 4000))


def test_the_plane_maps_points_to_observations_and_back():
    plane = envs.make("pendulum-swingup").plane
    points = torch.rand(5, 7, 2, dtype=torch.float64) * 6 - 3
    assert plane.to_observation(points).shape == (5, 7, 3)
    torch.testing.assert_close(plane.from_observation(plane.to_observation(points)), points)


def test_friction_alone_takes_energy():
    """dE/dt = −b ω²: what is lost over 10 s of free motion, and nothing but that."""
    env = envs.make("pendulum-swingup", velocity_noise=0.0, dtype=torch.float64)
    data = env.place(torch.full((1, 1, 1), 0.5).double(), torch.zeros(1, 1, 1).double())
    energies, losses = [], [0.0]
    for _ in range(201):
        θ, ω = env.qpos.item(), env.qvel.item()
        energies.append(0.5 * ω**2 + GRAVITY * math.cos(θ))
        losses.append(FRICTION * ω**2)
        data = env.step(data.set("action", torch.zeros(1, 1, 1)))["next"]
    lost = simpson(losses[1:], dx=0.05)
    assert lost > 3
    assert energies[0] - energies[-1] == pytest.approx(lost, abs=2e-3)
