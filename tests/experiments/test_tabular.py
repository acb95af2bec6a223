"""The table that GP Q-learning is compared with: its cells, its update, and that it learns."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from experiments.tabular import LEAST_RATE, Grid, Table, TabularQ


def pendulums(task: str = "pendulum-swingup") -> envs.BatchEnv:
    return envs.make(task, learners=2, num_envs=1, seed=0, threads=1)


def states(angles: list[float], speeds: list[float]) -> torch.Tensor:
    angle, speed = torch.tensor(angles), torch.tensor(speeds)
    points = torch.stack([angle.cos(), angle.sin(), speed], -1)
    return points.reshape(2, 1, 3)


def test_neighbours_share_a_cell_and_states_off_the_plane_belong_to_its_edge():
    table = Table(pendulums(), Grid(10, 3), epsilon=0.0, seed=0)
    one, other = (table.cell(states([0.1, 2.0], [speed, speed])) for speed in (0.1, 0.2))
    assert torch.equal(one, other)
    assert one[0] != one[1]
    edge, beyond = (table.cell(states([0.1, 2.0], [speed, speed])) for speed in (table.plane.high[1], 1e3))
    assert torch.equal(edge, beyond)
    assert int(table.cell(states([math.pi - 1e-3, 1.0], [1e3, 1e3])).max()) < 100


def step(table: Table, reward: float, terminated: bool) -> TensorDict:
    """Both learners take the second action in one state, which leads back to itself."""
    observation = states([0.5, -0.5], [0.0, 0.0])
    flag = torch.full((2, 1, 1), terminated)
    following = {"observation": observation, "reward": torch.full((2, 1, 1), reward), "terminated": flag}
    chosen = torch.ones(2, 1, 1, dtype=torch.long)
    return TensorDict({"observation": observation, "chosen": chosen, "next": following}, [2, 1])


@pytest.mark.parametrize("terminated", [False, True])
def test_updates_are_those_of_watkins(terminated):
    table = Table(pendulums(), Grid(10, 3), epsilon=0.0, seed=0)
    value = 0.0
    for visit in range(1, 30):
        table.learn(step(table, 1.0, terminated), discount=0.9)
        value += max(1 / visit, LEAST_RATE) * (1.0 + 0.9 * value * (not terminated) - value)
    cell = table.cell(states([0.5, -0.5], [0.0, 0.0]))
    learned = table.at(cell)[..., 1].flatten()
    torch.testing.assert_close(learned, torch.full_like(learned, value))
    assert table.value.count_nonzero() == 2


def test_the_policy_is_greedy_when_told_and_strays_otherwise():
    table = Table(pendulums(), Grid(4, 5), epsilon=0.3, seed=0)
    table.value[..., 3] = 1.0
    many = TensorDict({"observation": torch.randn(2, 1000, 3)}, [2, 1000])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert (table(many.clone())["chosen"] == 3).all()
    strayed = (table(many.clone())["chosen"] != 3).double().mean().item()
    # of 2,000 actions 0.3 · 4/5 stray; four standard deviations
    assert strayed == pytest.approx(0.24, abs=4 * math.sqrt(0.24 * 0.76 / 2000))


def test_every_step_of_every_learner_is_learned_once():
    learner = TabularQ(pendulums("pendulum-balance"), Grid(12, 3), total_frames=40, discount=0.95)
    assert len(list(learner.train())) == learner.frames == 40
    assert learner.policy.visits.sum((1, 2)).tolist() == [40, 40]
    # the start is near upright and the reward is positive: what was visited is worth something
    assert (learner.policy.value[learner.policy.visits > 0] > 0).all()
