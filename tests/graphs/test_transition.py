"""Shortest paths: closed forms, SciPy's Dijkstra after every kind of change, and the laws of a metric."""

import math

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import csgraph_from_dense, dijkstra
from torch import Tensor

from torch_gprl.graphs import NearestEdges, ThresholdEdges, TransitionGraph

COUNT = 12


class NoEdges:
    """Nodes stay alone until they are connected by hand."""

    def __call__(self, point: Tensor, nodes: Tensor, used: Tensor) -> Tensor:
        return torch.full_like(nodes[..., 0], torch.inf)


def by_hand(first: list[int], second: list[int], length: float = 1.0, nodes: int = COUNT) -> TransitionGraph:
    graph = TransitionGraph(1, nodes + 2, NoEdges())
    graph.add(torch.arange(nodes, dtype=torch.float64).unsqueeze(-1))
    lengths = torch.full((len(first),), length, dtype=torch.float64)
    graph.connect(torch.tensor(first), torch.tensor(second), lengths)
    return graph


def paths(graph: TransitionGraph) -> Tensor:
    used = graph.mask
    return graph.paths[used][:, used]


def dijkstra_of(graph: TransitionGraph) -> Tensor:
    """From the edges alone, by SciPy."""
    used = graph.mask
    lengths = graph.lengths[used][:, used].numpy()
    return torch.from_numpy(dijkstra(csgraph_from_dense(lengths, null_value=np.inf), directed=False))


def check(graph: TransitionGraph) -> None:
    torch.testing.assert_close(paths(graph), dijkstra_of(graph), rtol=1e-12, atol=1e-12)
    unused = ~graph.mask
    assert graph.paths[unused].isinf().all()
    assert graph.lengths[:, unused].isinf().all()
    assert not graph.points[unused].any()


STEP = torch.arange(COUNT).unsqueeze(-1) - torch.arange(COUNT)


def test_on_a_chain_paths_are_differences():
    graph = by_hand(list(range(COUNT - 1)), list(range(1, COUNT)), 0.5)
    torch.testing.assert_close(paths(graph), 0.5 * STEP.abs().double())


def test_on_a_ring_the_shorter_way_round_counts():
    graph = by_hand(list(range(COUNT)), [*range(1, COUNT), 0])
    torch.testing.assert_close(paths(graph), torch.minimum(STEP % COUNT, -STEP % COUNT).double())


def test_on_a_star_all_paths_but_the_centres_have_two_edges():
    graph = by_hand([0] * (COUNT - 1), list(range(1, COUNT)))
    expected = 2.0 * (1 - torch.eye(COUNT, dtype=torch.float64))
    expected[0, 1:] = expected[1:, 0] = 1
    torch.testing.assert_close(paths(graph), expected)


def test_on_a_complete_graph_paths_are_euclidean_distances():
    points = torch.randn(COUNT, 3, dtype=torch.float64)
    graph = TransitionGraph(3, COUNT, NearestEdges(COUNT))
    graph.add(points)
    torch.testing.assert_close(paths(graph), (points.unsqueeze(1) - points).norm(dim=-1))


def test_squared_lengths_shrink_a_straight_line_as_nodes_are_added():
    def end_to_end(nodes: int) -> float:
        points = torch.linspace(0, 3, nodes, dtype=torch.float64).unsqueeze(-1)
        graph = TransitionGraph(
            1, nodes, ThresholdEdges(math.exp(-1.01 * (3 / (nodes - 1)) ** 2), squared=True)
        )
        graph.add(points)
        return float(graph.paths[0, nodes - 1])

    assert [end_to_end(n) for n in (4, 8, 16)] == pytest.approx([3.0, 9 / 7, 9 / 15])


def test_threshold_edges_are_those_of_the_printed_equation():
    points = torch.rand(40, 2, dtype=torch.float64) * 2
    graph = TransitionGraph(2, 40, ThresholdEdges(0.7))
    graph.add(points)
    distance = (points.unsqueeze(1) - points).norm(dim=-1)
    joined = (torch.exp(-distance.square()) > 0.7).fill_diagonal_(True)
    assert torch.equal(graph.lengths.isfinite(), joined)
    torch.testing.assert_close(graph.lengths[joined], distance[joined])


@pytest.mark.parametrize("rule", [NearestEdges(1), ThresholdEdges(0.93)])
def test_paths_stay_those_of_dijkstra_through_random_changes(rule: NearestEdges | ThresholdEdges):
    graph = TransitionGraph(2, 40, rule)
    seen_parts = set()
    for _ in range(40):
        size, change = int(graph.size), int(torch.randint(4, ()))
        if size < 12 or (change == 0 and size < 35):
            points = torch.rand(5, 2, dtype=torch.float64) * 2
            points[0] = graph.points[0]  # and a copy of a node, joined by an edge of length 0
            graph.add(points)
        elif change == 1:
            first, second = torch.randint(size, (2, 3))
            graph.connect(first, second, torch.rand(3, dtype=torch.float64) * 0.2)
        else:
            gone = torch.zeros(40, dtype=torch.bool).scatter(0, torch.randperm(size)[:3], True)
            stay = ~gone[:size]
            before = paths(graph)[stay][:, stay]
            if change == 2:
                graph.eliminate(gone)
                torch.testing.assert_close(paths(graph), before, rtol=1e-12, atol=1e-12)
            else:
                graph.remove(gone)
                assert (paths(graph) >= before - 1e-12).all()
        check(graph)
        seen_parts.add(int(graph.components()))
    assert len(seen_parts) > 1  # connected and disconnected graphs were both seen


def test_an_eliminated_middle_keeps_its_path_and_a_removed_one_does_not():
    for keep, expected in ((True, 2.0), (False, torch.inf)):
        graph = by_hand([0, 1], [1, 2], nodes=3)
        middle = torch.tensor([False, True, False, False, False])
        (graph.eliminate if keep else graph.remove)(middle)
        assert float(graph.paths[0, 1]) == expected
        assert graph.size == 2


def test_components_and_degrees_are_counted():
    graph = by_hand([0, 1, 4], [1, 2, 5], nodes=7)
    assert int(graph.components()) == 4  # {0 1 2} {3} {4 5} {6}
    assert graph.degrees()[:7].tolist() == [1, 2, 1, 0, 1, 1, 0]


def grown(points: Tensor) -> TransitionGraph:
    graph = TransitionGraph(points.shape[-1], 30, ThresholdEdges(0.8), points.shape[:-2])
    graph.add(points)
    return graph


def test_renaming_the_nodes_of_a_threshold_graph_changes_nothing():
    points, order = torch.rand(30, 2, dtype=torch.float64) * 3, torch.randperm(30)
    torch.testing.assert_close(grown(points[order]).paths, grown(points).paths[order][:, order])


def test_paths_are_a_metric_and_a_new_node_never_lengthens_one():
    points = torch.rand(30, 2, dtype=torch.float64) * 3
    graph, before = grown(points[:1]), torch.zeros(1, 1, dtype=torch.float64)
    for i in range(1, 30):
        graph.add(points[i : i + 1])
        found = paths(graph)
        assert (found[:i, :i] <= before).all()
        assert torch.equal(found, found.mT)
        assert not found.diagonal().any()
        assert (found <= (found.unsqueeze(-1) + found.unsqueeze(0)).amin(1) * (1 + 1e-12)).all()
        before = found


def test_a_learner_of_a_batch_has_the_graph_that_it_would_have_alone():
    points = torch.rand(2, 8, 2, dtype=torch.float64) * 2
    wanted = torch.rand(2, 8) < 0.7
    batch = TransitionGraph(2, 10, NearestEdges(2), (2,))
    batch.add(points, wanted)
    gone = torch.zeros(2, 10, dtype=torch.bool)
    gone[0, 1] = gone[1, 0] = gone[1, 2] = True
    for change in ("eliminate", "remove", "follow"):
        alone = []
        for learner in range(2):
            single = TransitionGraph(2, 10, NearestEdges(2))
            single.load_state_dict({key: value[learner] for key, value in batch.state_dict().items()})
            alone.append(single)
        arguments = [(points[i], wanted[i].roll(1)) if change == "follow" else (gone[i],) for i in range(2)]
        for single, given in zip(alone, arguments, strict=True):
            getattr(single, change)(*given)
        getattr(batch, change)(*map(torch.stack, zip(*arguments, strict=True)))
        for learner, single in enumerate(alone):
            for key, value in single.state_dict().items():
                torch.testing.assert_close(batch.state_dict()[key][learner], value)


def test_following_a_basis_leaves_just_its_vectors_as_nodes():
    points = torch.rand(9, 2, dtype=torch.float64)
    graph = grown(points[:6])
    before = graph.paths[3:6, 3:6].clone()
    graph.follow(points[3:], torch.tensor([True] * 5 + [False]))
    assert torch.equal(graph.points[:5], points[3:8])
    assert int(graph.size) == 5
    assert (graph.paths[:3, :3] <= before).all()
    check(graph)


def test_mistakes_are_named():
    graph = by_hand([0], [1], nodes=2)
    with pytest.raises(ValueError, match="at most 4 nodes, got 5"):
        graph.add(torch.zeros(3, 1, dtype=torch.float64))
    with pytest.raises(ValueError, match="nodes in use"):
        graph.connect(torch.tensor([0]), torch.tensor([2]), torch.ones(1, dtype=torch.float64))
    with pytest.raises(ValueError, match="between 0 and 1"):
        ThresholdEdges(1.0)
    with pytest.raises(ValueError, match="at least 1"):
        NearestEdges(0)
