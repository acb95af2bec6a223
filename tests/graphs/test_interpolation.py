"""Neighbours are the nearest nodes in use, however they are searched for."""

import pytest
import torch

from torch_gprl.graphs.interpolation import TREE_COLUMNS, TREE_INPUTS, neighbours


@pytest.mark.parametrize("columns", [1, 3, TREE_COLUMNS, TREE_COLUMNS + 1])
@pytest.mark.parametrize("inputs", [1, TREE_INPUTS - 1, TREE_INPUTS, 200])
def test_neighbours_are_the_nearest_nodes_in_use(columns: int, inputs: int):
    x = torch.randn(3, 1, inputs, columns, dtype=torch.float64)
    nodes = torch.randn(2, 40, columns, dtype=torch.float64)
    used = torch.rand(2, 40) < 0.7
    found = neighbours(x, nodes, used, 4)
    distance = torch.linalg.vector_norm(x.unsqueeze(-2) - nodes.unsqueeze(-3), dim=-1)
    expected = distance.masked_fill(~used.unsqueeze(-2), torch.inf).sort(-1)
    torch.testing.assert_close(found.distance, expected.values[..., :4])
    torch.testing.assert_close(found.nodes, expected.indices[..., :4])
    torch.testing.assert_close(found.weight.sum(-1), torch.ones(3, 2, inputs, dtype=torch.float64))


@pytest.mark.parametrize("inputs", [1, 2 * TREE_INPUTS])
def test_where_nodes_are_too_few_the_missing_ones_weigh_nothing(inputs: int):
    x, nodes = torch.randn(inputs, 2, dtype=torch.float64), torch.randn(9, 2, dtype=torch.float64)
    used = torch.arange(9) == 5
    found = neighbours(x, nodes, used, 3)
    assert (found.nodes[:, 0] == 5).all()
    torch.testing.assert_close(found.weight, torch.tensor([1.0, 0.0, 0.0]).double().expand(inputs, 3))
    assert found.distance[:, 1:].isinf().all()
    assert neighbours(x, nodes, used & False, 3).weight.count_nonzero() == 0
