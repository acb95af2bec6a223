"""Visited states: where they lead, what stands near them, and distances along them."""

import math

import pytest
import torch
from scipy.sparse.csgraph import csgraph_from_dense, shortest_path
from torch import Tensor

from torch_gprl.graphs import Experience
from torch_gprl.graphs.geodesics import geodesics
from torch_gprl.graphs.interpolation import neighbours

ROTATION = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)


def trajectories(count: int = 6, steps: int = 12, *batch: int) -> tuple[Tensor, Tensor]:
    """States and next states of a linear system, trajectory after trajectory: [*batch, count · steps, 2]."""
    here = torch.randn(*batch, count, 2, dtype=torch.float64)
    path = [here]
    for _ in range(steps):
        path.append(path[-1] @ ROTATION.mT)
    states = torch.stack(path, -2)
    return states[..., :-1, :].flatten(-3, -2), states[..., 1:, :].flatten(-3, -2)


def filled(capacity: int = 80, **options: int) -> Experience:
    experience = Experience(2, capacity, 10, **options)
    experience.add(*trajectories())
    return experience


def test_weights_of_neighbours_sum_to_one_and_a_node_has_all_of_its_own():
    nodes, used = torch.randn(20, 2, dtype=torch.float64), torch.arange(20) < 15
    found = neighbours(torch.cat([nodes, 3 * nodes]), nodes, used, 4)
    torch.testing.assert_close(found.weight.sum(-1), torch.ones(40, dtype=torch.float64))
    assert (found.nodes < 15).all()
    assert torch.equal(found.nodes[:15, 0], torch.arange(15))
    torch.testing.assert_close(found.average(nodes)[:15], nodes[:15], rtol=0, atol=1e-12)


def test_weights_change_continuously_as_neighbours_come_and_go():
    nodes = torch.randn(12, 2, dtype=torch.float64)
    line = torch.linspace(-2, 2, 20_001, dtype=torch.float64).unsqueeze(-1) * torch.tensor([1.0, 0.7])
    values = torch.randn(12, 1, dtype=torch.float64)
    along = neighbours(line, nodes, torch.ones(12, dtype=torch.bool), 3).average(values)
    assert float(along.diff(dim=0).abs().max()) < 0.02


def test_too_few_nodes_are_no_neighbours():
    found = neighbours(torch.zeros(3, 2), torch.ones(4, 2), torch.tensor([True, False, False, False]), 2)
    torch.testing.assert_close(found.weight, torch.tensor([[1.0, 0.0]]).expand(3, 2))
    nothing = neighbours(torch.zeros(3, 2), torch.ones(4, 2), torch.zeros(4, dtype=torch.bool), 2)
    assert not nothing.weight.any()


def test_in_a_linear_system_the_successor_of_any_input_is_exact():
    experience = filled()
    x = torch.randn(30, 2, dtype=torch.float64)
    point, alive = experience.successor(x)
    torch.testing.assert_close(point, x @ ROTATION.mT, rtol=0, atol=0.02)  # the ridge is in the way
    torch.testing.assert_close(alive, torch.ones(30, dtype=torch.float64))
    visited = experience.states[experience.mask]
    torch.testing.assert_close(experience.successor(visited).point, visited @ ROTATION.mT, rtol=0, atol=1e-9)


def test_inputs_near_a_terminated_transition_are_not_alive():
    states, next_states = trajectories()
    experience = Experience(2, 80, 10, interpolate=1)
    terminated = torch.zeros(72, dtype=torch.bool)
    terminated[11] = True
    experience.add(states, next_states, terminated)
    assert experience.successor(states[10:12] + 1e-4).alive.tolist() == [1, 0]
    assert not experience.ends[11]


def test_links_follow_trajectories_and_their_ends_are_known():
    experience = filled()
    inside = torch.arange(72) % 12 != 11
    assert torch.equal(experience.ends[:72], ~inside)
    assert torch.equal(experience.after_nodes[:72, 0][inside], torch.arange(1, 73)[inside])
    weights = experience.after_weights[:72]
    torch.testing.assert_close(weights.sum(-1), torch.ones(72, dtype=torch.float64))


def test_the_oldest_transitions_make_room():
    experience, (states, next_states) = Experience(2, 30, 4), trajectories()
    for part in (slice(0, 20), slice(20, 40), slice(40, 72)):
        experience.add(states[part], next_states[part])
        assert int(experience.size) == min(part.stop, 30)
    assert torch.equal(experience.states, states[-30:])
    assert torch.equal(experience.next_states, next_states[-30:])


def test_landmarks_are_spread_out():
    experience = filled()
    chosen = experience.states[experience.landmarks]
    closest = torch.pdist(chosen).min()
    cover = torch.cdist(experience.states[:72], chosen).min(-1).values.max()
    assert closest >= cover  # no state is farther from all landmarks than they are from each other


def test_a_learner_of_a_batch_has_the_experience_that_it_would_have_alone():
    states, next_states = trajectories(6, 12, 2)
    batch = Experience(2, 80, 10, batch_shape=(2,))
    batch.add(states, next_states)
    x = torch.randn(2, 5, 2, dtype=torch.float64)
    for learner in range(2):
        alone = Experience(2, 80, 10)
        alone.add(states[learner], next_states[learner])
        for key, value in alone.state_dict().items():
            other = batch.state_dict()[key]
            torch.testing.assert_close(other if other.ndim == value.ndim else other[learner], value)
        torch.testing.assert_close(batch.successor(x).point[learner], alone.successor(x[learner]).point)


def test_geodesics_are_shortest_paths_and_count_their_edges_in_time():
    count, step = 30, 0.1
    points = torch.rand(count, 2, dtype=torch.float64)
    near = neighbours(points, points, torch.ones(count, dtype=torch.bool), 4)
    temporal = torch.stack([torch.arange(20), torch.arange(1, 21)], -1)
    landmarks = torch.tensor([3, 25])
    found = geodesics((near.nodes, near.distance), temporal, step, landmarks)

    def dense(step: float) -> Tensor:
        lengths = torch.full((count, count), torch.inf, dtype=torch.float64)
        lengths.scatter_(1, near.nodes, near.distance)
        first, second = temporal.unbind(-1)
        lengths[first, second] = lengths[first, second].clamp_max(step)
        lengths = torch.minimum(lengths, lengths.mT)
        graph = csgraph_from_dense(lengths.numpy(), null_value=math.inf)
        return torch.from_numpy(shortest_path(graph, directed=False))[landmarks]

    torch.testing.assert_close(found.distance, dense(step))
    # the slope of a path in the length of an edge in time is how many of these it has
    torch.testing.assert_close(found.steps, (dense(step + 1e-7) - dense(step)) / 1e-7, rtol=0, atol=1e-5)
    assert found.steps.max() > 2


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="below the capacity 5"):
        Experience(2, 5, 3, slope_neighbours=5)
    with pytest.raises(ValueError, match="landmarks must be from 1 to the capacity 20"):
        Experience(2, 20, 21)


def linear_experience(A: Tensor, *batch: int) -> Experience:
    """Trajectories of x' = A x."""
    path = [torch.randn(*batch, 12, len(A), dtype=torch.float64)]
    for _ in range(6):
        path.append(path[-1] @ A.mT)
    states = torch.stack(path, -2)
    experience = Experience(len(A), 80, 10, batch_shape=batch)
    experience.add(states[..., :-1, :].flatten(-3, -2), states[..., 1:, :].flatten(-3, -2))
    return experience


def test_a_graph_in_other_units_is_that_of_inputs_in_these_units():
    A = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)
    units = torch.tensor([0.2, 5.0], dtype=torch.float64)
    experience = linear_experience(A)
    states, next_states = experience.states[experience.mask], experience.next_states[experience.mask]
    x = torch.randn(15, 2, dtype=torch.float64)
    before = experience.nearest(x).nodes
    experience.measure(units)
    scaled = Experience(2, 80, 10)
    scaled.add(states / units, next_states / units)
    assert not torch.equal(experience.nearest(x).nodes, before)
    for found, expected in zip(experience.nearest(x), scaled.nearest(x / units), strict=True):
        torch.testing.assert_close(found, expected)
    torch.testing.assert_close(experience.landmarks, scaled.landmarks)
    torch.testing.assert_close(experience.successor(x).point, scaled.successor(x / units).point * units)


def test_length_scales_are_pulled_back_along_the_flow():
    """A position that values want to know makes speed count, and what moves neither does not."""
    A = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.95, 0.0], [0.0, 0.0, 0.9]], dtype=torch.float64)
    lengthscale, discount = torch.tensor([0.5, 20.0, 2.0], dtype=torch.float64), 0.97
    experience = linear_experience(A)
    experience.slopes.copy_(A)
    found = experience.pulled_back(lengthscale, discount, steps=6)
    rates = [
        discount ** (2 * k)
        * (torch.linalg.matrix_power(A, k).square() / lengthscale.square()[:, None]).sum(0)
        for k in range(7)
    ]
    expected = torch.stack(rates).max(0).values.rsqrt()
    torch.testing.assert_close(found, expected)
    assert found[1] < 2
    torch.testing.assert_close(found[2], lengthscale[2])


def test_learners_pull_back_apart_and_nothing_seen_changes_nothing():
    A = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)
    lengthscale = torch.tensor([0.3, 4.0], dtype=torch.float64)
    torch.testing.assert_close(Experience(2, 20, 4).pulled_back(lengthscale, 0.9), lengthscale)
    torch.manual_seed(3)
    batch = linear_experience(A, 2)
    found = batch.pulled_back(lengthscale, 0.9)
    for learner in range(2):
        alone = Experience(2, 80, 10)
        alone.add(batch.states[learner, batch.mask], batch.next_states[learner, batch.mask])
        torch.testing.assert_close(alone.pulled_back(lengthscale, 0.9), found[learner])


def test_folds_leave_whole_trajectories_out_in_different_ways_and_never_all():
    experience = Experience(2, 120, 10)
    experience.add(*trajectories(9, 12))
    number = torch.arange(120) // 12
    for way in range(2):
        for fold, kept in enumerate(experience.without_folds(3, way)):
            assert torch.equal(kept, experience.mask & (number // 3**way % 3 != fold))
    lacking = [~torch.stack(experience.without_folds(3, way))[:, :108] for way in range(2)]
    shared = lacking[0].double() @ lacking[1].double().mT
    torch.testing.assert_close(shared, torch.full_like(shared, 12))  # one trajectory
    alone = Experience(2, 80, 10)
    alone.add(*trajectories(1, 12))
    assert all(torch.equal(kept, alone.mask) for kept in alone.without_folds(3, 1))


def test_a_trajectory_of_states_and_actions_goes_on_though_another_action_was_taken():
    states, next_states = trajectories(4, 12)
    actions, next_actions = torch.randn(2, 48, 1, dtype=torch.float64)
    experience = Experience(3, 80, 10)
    experience.add(torch.cat([states, actions], -1), torch.cat([next_states, next_actions], -1))
    assert torch.equal(experience.without_folds(2)[0], experience.mask & (torch.arange(80) // 12 % 2 == 1))
