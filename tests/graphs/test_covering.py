"""Points that cover others: each pick is the farthest from those before it."""

import pytest
import torch

from torch_gprl.graphs import farthest_points


def test_each_pick_is_the_point_farthest_from_those_before():
    points = torch.randn(2, 40, 3, dtype=torch.float64)
    index, distance = farthest_points(points, 10)
    assert distance[:, 0].isinf().all()
    for picks, away, row in zip(index, distance, points, strict=True):
        for count in range(1, 10):
            nearest = torch.cdist(row, row[picks[:count]]).amin(1)
            assert picks[count] == nearest.argmax()
            assert away[count] == pytest.approx(float(nearest.max()))


def test_farthest_points_cover_the_others_at_most_twice_as_widely_as_any_choice():
    points = torch.tensor([[0.0], [1.0], [10.0], [11.0], [20.0], [21.0]])
    chosen = farthest_points(points, 3).chosen
    assert sorted((points[chosen, 0] // 10).tolist()) == [0, 1, 2]  # one of each pair


def test_farthest_points_are_all_points_when_there_are_few_and_no_point_twice():
    points = torch.zeros(2, 5, 3)  # all alike
    assert farthest_points(points, 9).chosen.sort(-1).values.tolist() == [list(range(5))] * 2


@pytest.mark.parametrize("count", [1, 4])
def test_each_batch_entry_chooses_for_itself(count):
    points = torch.randn(3, 20, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    together = farthest_points(points, count).chosen
    assert torch.equal(together, torch.stack([farthest_points(each, count).chosen for each in points]))
