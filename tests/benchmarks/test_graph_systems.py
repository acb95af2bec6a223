"""The machines of the graph benchmark: their motion, their values, and what a learner sees of them."""

import dataclasses

import pytest
import torch
from torch import Tensor

from benchmarks import graph_systems
from benchmarks.graph_machines import GRAVITY, Atwood, CartPole, Jump, Spiral
from benchmarks.graph_maze import DOCK, GOAL, WALLS, Maze
from benchmarks.graph_systems import DISCOUNT, System, experience, true_values

MACHINES = (Jump(), Spiral(), CartPole(), Atwood(), Jump(action_values=True))


def free(system: System, states: Tensor) -> Tensor:
    """A second of motion without action, in small steps."""
    for _ in range(20):
        states = system.step(states, torch.zeros(len(states), dtype=torch.float64))[0]
    return states


def test_without_action_and_friction_energy_stays(monkeypatch):
    monkeypatch.setattr(Jump, "friction", 0.0)
    states = Jump().sample(50)
    energies = [0.5 * s[:, 1].square() + GRAVITY * s[:, 0].cos() for s in (states, free(Jump(), states))]
    torch.testing.assert_close(energies[0], energies[1], rtol=1e-3, atol=1e-2)
    machine = dataclasses.replace(Atwood())
    states = machine.sample(50) * torch.tensor([0.3, 1.0, 0.3, 0.0]).double()

    def energy(s: Tensor) -> Tensor:
        kinetic = 0.5 * machine.bob * (s[:, 1] * s[:, 2]).square()
        kinetic = kinetic + 0.5 * (machine.bob + machine.weight) * s[:, 3].square()
        height = machine.weight * GRAVITY * s[:, 1] - machine.bob * GRAVITY * s[:, 1] * s[:, 0].cos()
        return kinetic + height

    after = states
    for _ in range(4):  # before a stop is reached
        after = machine.step(after, torch.zeros(50, dtype=torch.float64))[0]
    moving = (after[:, 1] > machine.shortest) & (after[:, 1] < machine.longest)
    assert moving.sum() > 10
    torch.testing.assert_close(energy(states)[moving], energy(after)[moving], rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("system", MACHINES, ids=lambda system: system.name)
def test_policies_make_ridges_and_learners_see_their_returns(system: System, monkeypatch):
    monkeypatch.setattr(graph_systems, "HORIZON", 60)  # long enough to be caught or to fall
    torch.manual_seed(0)
    truth = true_values(system, system.sample(60))
    assert truth.near.any()
    assert not truth.near.all()
    seen = experience(system, truth, 0, 3, 10, noise=0.0)
    assert seen.states.shape == (3, 10, truth.points.shape[-1])
    assert seen.targets.isfinite().all()


def test_values_keep_to_bellman_and_a_policys_own_action_changes_nothing():
    system = Spiral()
    states = system.sample(20)
    values, (following, reward) = system.values(states), system.step(states, system.control(states))
    torch.testing.assert_close(values, reward + DISCOUNT * system.values(following), rtol=0, atol=0.02)
    torch.testing.assert_close(system.values(states, system.control(states)), values)


def test_walls_let_nothing_through_and_the_policy_finds_the_way_round_them():
    maze = Maze()
    state = maze.sample(300)
    for step in range(250):
        heading = maze.control(state) if step >= 50 else maze.act(state, 2.0)
        following = maze.step(state, heading)[0]
        for place, low, high in WALLS:
            crossed = (state[:, 0] < place) != (following[:, 0] < place)
            share = (place - state[:, 0]) / (following[:, 0] - state[:, 0])
            height = (state[:, 1] + share * (following[:, 1] - state[:, 1]))[crossed]
            assert ((height < low) | (height > high)).all()
        state = following
    assert float((state - torch.tensor(GOAL)).norm(dim=-1).max()) < DOCK


def test_after_a_change_of_policy_half_of_the_trajectories_are_those_of_the_older_one(monkeypatch):
    monkeypatch.setattr(graph_systems, "HORIZON", 60)
    older = Jump(catch_angle=0.2)
    system = Jump(before=older)
    states = system.sample(40)
    truth = true_values(system, states)
    mixed = experience(system, truth, 1, 8, 5, noise=0.0)
    old = experience(older, truth, 1, 4, 5, noise=0.0)
    torch.testing.assert_close(mixed.states[:4], old.states)
    torch.testing.assert_close(mixed.targets[:4], old.targets)
    assert older.name == "jump"
    assert system.name == "jump, changed policy"
