"""The car on the hill against its equation, written out here a second time."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.envs.trajectories import after_a_step, simulated

GRAVITY = 9.81


def slopes(p: float, left: bool) -> tuple[float, float]:
    if left:
        return 2 * p + 1, 2.0
    return (1 + 5 * p * p) ** -1.5, -15 * p * (1 + 5 * p * p) ** -2.5


def drive(start: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """States by DOP853, stopped and started again where the two curves join."""
    states = [start]
    for action in actions:
        now, state = 0.0, states[-1]
        left = state[0] < 0
        while now < 0.1:

            def rate(_, x, u=action[0], left=left):
                first, second = slopes(x[0], left)
                return [x[1], (u - GRAVITY * first - x[1] ** 2 * first * second) / (1 + first**2)]

            def joint(_, x, left=left):
                return x[0] + (1e-13 if left else 0)

            joint.terminal, joint.direction = True, 1.0 if left else -1.0
            part = solve_ivp(rate, (now, 0.1), state, "DOP853", rtol=1e-10, atol=1e-10, events=joint)
            now, state = part.t[-1], part.y[:, -1]
            left ^= part.status == 1
        states.append(state)
    return np.stack(states)


def test_it_moves_as_the_equation_says():
    rng = np.random.default_rng(0)
    crossings = 0
    for start in rng.uniform([-0.5, -0.5], [0.3, 0.5], (8, 2)):
        actions = rng.uniform(-4, 4, (50, 1))
        states = simulated("car-on-hill", start, actions)
        over = np.flatnonzero((np.abs(states[:, 0]) > 1) | (np.abs(states[:, 1]) > 3))
        steps = over[0] if over.size else 50
        assert np.abs(states[: steps + 1] - drive(start, actions[:steps])).max() < 1e-4
        crossings += (np.diff(np.sign(states[: steps + 1, 0])) != 0).sum()
    assert crossings > 3


@pytest.mark.parametrize(
    ("start", "reward"),
    [((0.95, 2.0), 1), ((-0.95, -1.5), -1), ((0.9, 3.5), -1), ((-0.8, -4.5), -1), ((0.0, 0.0), 0)],
)
def test_the_goal_pays_and_a_crash_costs_and_both_end_the_episode(start, reward):
    _, out = after_a_step("car-on-hill", list(start), 0.0)
    assert out["reward"].item() == reward
    assert out["terminated"].item() == (reward != 0)


def test_full_throttle_does_not_reach_the_top_but_rolling_back_first_does():
    straight = simulated("car-on-hill", np.array([-0.5, 0.0]), np.full((20, 1), 4.0))
    assert straight[:, 0].max() < 0.9
    swing = simulated("car-on-hill", np.array([-0.5, 0.0]), np.array([[-4.0]] * 9 + [[4.0]] * 16))
    top = np.flatnonzero(swing[:, 0] > 1)
    assert top.size
    assert math.fabs(swing[top[0], 1]) < 3
