"""Kernels on the nodes of a graph: covariances on any graph, exact at nodes, and honest away from them."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from torch_gprl.graphs import NearestEdges, ThresholdEdges, TransitionGraph
from torch_gprl.kernels import GraphMatern, Matern, ShortestPathKernel, SquaredExponential
from torch_gprl.kernels.graph_nodes import NodeKernel
from torch_gprl.kernels.graph_psd import repaired_correlation

Make = Callable[[TransitionGraph], NodeKernel]

KINDS: dict[str, Make] = {
    "nearest node, laplacian": lambda graph: ShortestPathKernel(graph, 0.7, 1.3),
    "nearest node, gaussian": lambda graph: ShortestPathKernel(graph, 0.7, 1.3, 1, "gaussian"),
    "interpolated, laplacian": lambda graph: ShortestPathKernel(graph, 0.7, 1.3, 4),
    "interpolated, gaussian": lambda graph: ShortestPathKernel(graph, 0.7, 1.3, 4, "gaussian"),
    "matern": lambda graph: GraphMatern(graph, 0.7, 1.3, 4, 1.5),
    "heat": lambda graph: GraphMatern(graph, 0.7, 1.3, 1, math.inf),
}


@pytest.fixture(params=KINDS, scope="module")
def make(request: pytest.FixtureRequest) -> Make:
    return KINDS[request.param]


def random_graph(seed: int = 0, nodes: int = 25, rule: object = None, capacity: int = 30) -> TransitionGraph:
    torch.manual_seed(seed)
    graph = TransitionGraph(2, capacity, rule or NearestEdges(3))
    graph.add(torch.rand(nodes, 2, dtype=torch.float64) * 2)
    return graph


def inputs(count: int) -> Tensor:
    return torch.rand(count, 2, dtype=torch.float64) * 3 - 0.5


def ring(nodes: int) -> TransitionGraph:
    """Unit edges round a ring; the nodes themselves lie far apart."""
    graph = TransitionGraph(1, nodes + 1, ThresholdEdges(0.999))
    graph.add(10 * torch.arange(nodes, dtype=torch.float64).unsqueeze(-1))
    here = torch.arange(nodes)
    graph.connect(here, here.roll(-1), torch.ones(nodes, dtype=torch.float64))
    return graph


@pytest.mark.parametrize("rule", [NearestEdges(3), ThresholdEdges(0.7), ThresholdEdges(0.95)])
@pytest.mark.parametrize("nodes", [0, 1, 2, 25])
def test_gram_matrices_are_covariances_with_the_stated_variance(make: Make, rule: object, nodes: int):
    for seed in range(3):
        graph = random_graph(seed, nodes, rule)
        x = torch.cat([inputs(20), graph.points[:nodes], 50 + inputs(2)])
        kernel = make(graph)
        gram = kernel(x, x).detach()
        torch.testing.assert_close(gram, gram.mT, rtol=0, atol=1e-11)
        torch.testing.assert_close(gram.diagonal(), kernel.diag(x).detach(), rtol=1e-11, atol=0)
        torch.testing.assert_close(kernel(x, x.clone()), gram, rtol=0, atol=1e-5)
        assert torch.linalg.eigvalsh(gram)[0] > -1e-11


def test_at_the_nodes_the_kernel_is_that_of_the_graph(make: Make):
    graph = random_graph()
    kernel, used = make(graph), graph.points[:25]
    expected = 1.3 * kernel.node_correlation()[:25, :25]
    torch.testing.assert_close(kernel(used, used), expected, rtol=0, atol=1e-11)


def test_far_from_all_nodes_an_ordinary_matern_kernel_remains(make: Make):
    kernel, x = make(random_graph()), 30 + inputs(6)
    torch.testing.assert_close(kernel(x, x), Matern(2, 0.7, 1.3, smoothness=0.5)(x, x), rtol=1e-9, atol=1e-9)


def test_renaming_the_nodes_changes_nothing(make: Make):
    graph, renamed = random_graph(rule=ThresholdEdges(0.8)), TransitionGraph(2, 30, ThresholdEdges(0.8))
    renamed.add(graph.points[:25].flip(0))
    x = inputs(20)
    torch.testing.assert_close(make(graph)(x, x), make(renamed)(x, x), rtol=0, atol=1e-9)


def test_a_learner_of_a_batch_has_the_kernel_of_its_own_graph(make: Make):
    graph = TransitionGraph(2, 12, NearestEdges(2), (2,))
    graph.add(torch.rand(2, 8, 2, dtype=torch.float64), torch.rand(2, 8) < 0.8)
    x, z = inputs(5), torch.rand(2, 4, 2, dtype=torch.float64)
    batch = make(graph)(x, z)
    assert batch.shape == (2, 5, 4)
    for learner in range(2):
        alone = TransitionGraph(2, 12, NearestEdges(2))
        alone.load_state_dict({key: value[learner] for key, value in graph.state_dict().items()})
        torch.testing.assert_close(make(alone)(x, z[learner]), batch[learner], rtol=0, atol=1e-11)


def test_gradients_agree_with_finite_differences(make: Make):
    kernel = make(random_graph())
    names = [name for name, _ in kernel.named_parameters()]

    def covariance(x: Tensor, z: Tensor, *parameters: Tensor) -> Tensor:
        return functional_call(kernel, dict(zip(names, parameters, strict=True)), (x, z))

    arguments = inputs(4).requires_grad_(), inputs(3).requires_grad_(), *kernel.parameters()
    assert torch.autograd.gradcheck(covariance, arguments, atol=1e-4)


def test_gradients_are_finite_at_nodes_and_coincident_points(make: Make):
    graph = random_graph()
    kernel, x = make(graph), graph.points[:5].clone().requires_grad_()
    for gram in (kernel(x, x), kernel(x, x.detach().clone())):
        gradients = torch.autograd.grad(gram.sum(), [x, *kernel.parameters()])
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_a_kernel_sees_its_graph_grow_also_without_gradients(make: Make):
    graph = random_graph(nodes=10)
    kernel, x = make(graph), inputs(8)
    with torch.no_grad():
        before = kernel(x, x)
        graph.add(x[:4])
        after = kernel(x, x)
        kernel.lengthscale = 0.2
        retuned = kernel(x, x)
    assert not torch.allclose(before, after)
    torch.testing.assert_close(kernel(x, x), retuned)  # with gradients nothing is remembered


def test_single_precision_is_the_same_to_single_precision(make: Make):
    x = inputs(6)
    single = make(random_graph()).to(torch.float32)(x.float(), x.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), make(random_graph())(x, x), rtol=1e-3, atol=1e-3)


def test_on_a_ring_of_four_the_gaussian_of_path_lengths_is_no_covariance_and_its_repair_is():
    path = torch.tensor([[0, 1, 2, 1], [1, 0, 1, 2], [2, 1, 0, 1], [1, 2, 1, 0]], dtype=torch.float64)
    printed = torch.exp(-path.square() / 2)
    assert float(torch.linalg.eigvalsh(printed)[0]) == pytest.approx(1 - 2 * math.exp(-0.5) + math.exp(-2))
    x = ring(4).points[:4]
    kernel = ShortestPathKernel(ring(4), 1.0, 1.0, 1, "gaussian")
    eigenvalues, vectors = torch.linalg.eigh(printed)
    clipped = vectors @ torch.diag(eigenvalues.clamp_min(0)) @ vectors.mT
    torch.testing.assert_close(kernel(x, x), clipped / clipped[0, 0], rtol=0, atol=1e-6)


def test_on_trees_the_laplacian_needs_no_repair():
    graph = TransitionGraph(1, 21, ThresholdEdges(0.999))
    graph.add(10 * torch.arange(20, dtype=torch.float64).unsqueeze(-1))
    child = torch.arange(1, 20)
    parent = (torch.rand(19) * child).long()
    graph.connect(child, parent, torch.rand(19, dtype=torch.float64))
    kernel = ShortestPathKernel(graph, 0.7)
    expected = torch.exp(-graph.paths[:20, :20] / 0.7)
    assert torch.linalg.eigvalsh(expected)[0] > 0
    torch.testing.assert_close(kernel.node_correlation()[:20, :20], expected, rtol=0, atol=1e-13)


def test_on_a_complete_graph_the_gaussian_is_the_squared_exponential():
    points = torch.randn(12, 2, dtype=torch.float64)
    graph = TransitionGraph(2, 13, NearestEdges(12))
    graph.add(points)
    kernel = ShortestPathKernel(graph, 0.8, 1.3, 1, "gaussian")
    torch.testing.assert_close(
        kernel(points, points), SquaredExponential(2, 0.8, 1.3)(points, points), rtol=0, atol=1e-9
    )


def test_between_unconnected_parts_nothing_is_shared():
    graph = TransitionGraph(1, 6, ThresholdEdges(0.5))
    graph.add(torch.tensor([[0.0], [0.5], [5.0], [5.5]], dtype=torch.float64))
    assert not ShortestPathKernel(graph).node_correlation()[:2, 2:4].any()


@pytest.mark.parametrize("smoothness", [0.5, 1.5, math.inf])
def test_on_a_ring_graph_matern_is_the_fourier_sum(smoothness: float):
    count, lengthscale = 9, 1.4
    kernel = GraphMatern(ring(count), lengthscale, 1.0, 1, smoothness)
    frequency = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    eigenvalue = 2 - 2 * frequency.cos()  # of the Laplacian of a ring with unit edges
    if math.isinf(smoothness):
        spectrum = (-(lengthscale**2) * eigenvalue / 2).exp()
    else:
        spectrum = (2 * smoothness / lengthscale**2 + eigenvalue) ** -smoothness
    step = torch.arange(count).unsqueeze(-1) - torch.arange(count)
    fourier = (spectrum * (frequency * step.unsqueeze(-1)).cos()).sum(-1)
    torch.testing.assert_close(kernel.node_correlation()[:count, :count], fourier / fourier[0, 0])


def test_the_repair_leaves_covariances_alone_and_has_the_right_slope():
    torch.manual_seed(1)
    matrix = torch.randn(2, 6, 6, dtype=torch.float64)
    correlation = 0.5 * (matrix + matrix.mT) / 4 + torch.eye(6, dtype=torch.float64)
    indefinite = (correlation - 0.8 * torch.eye(6, dtype=torch.float64)).requires_grad_()
    assert (torch.linalg.eigvalsh(indefinite).amin(-1) < 0).all()

    def repaired(raw: Tensor) -> Tensor:
        return repaired_correlation((raw + raw.mT) / 2)

    assert torch.autograd.gradcheck(repaired, indefinite)
    x = inputs(6)
    covariance = Matern(2)(x, x).detach()
    torch.testing.assert_close(repaired_correlation(covariance), covariance, rtol=0, atol=1e-14)


def test_options_out_of_range_are_named():
    graph = random_graph()
    with pytest.raises(ValueError, match="interpolate must be at least 1"):
        ShortestPathKernel(graph, interpolate=0)
    with pytest.raises(ValueError, match="smoothness must be positive"):
        GraphMatern(graph, smoothness=0.0)
