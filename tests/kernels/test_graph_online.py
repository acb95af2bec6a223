"""Kernels on graphs inside the sparse online process: the graph grows with the data, nothing goes stale."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torch_gprl.gp import ExactGP, SparseOnlineGP, fit_hyperparameters
from torch_gprl.graphs import Experience, NearestEdges, ThresholdEdges, TransitionGraph
from torch_gprl.kernels import GeodesicKernel, GraphMatern, Matern, ShortestPathKernel, SuccessorKernel
from torch_gprl.kernels.graph_nodes import NodeKernel

NOISE = 0.05
ROTATION = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)

ON_NODES: dict[str, Callable[[TransitionGraph], NodeKernel]] = {
    "nearest, laplacian": lambda graph: ShortestPathKernel(graph, 0.7),
    "interpolated, laplacian": lambda graph: ShortestPathKernel(graph, 0.7, interpolate=4),
    "interpolated, gaussian": lambda graph: ShortestPathKernel(graph, 0.7, interpolate=4, shape="gaussian"),
    "matern": lambda graph: GraphMatern(graph, 0.7, interpolate=4),
    "heat": lambda graph: GraphMatern(graph, 0.5, smoothness=math.inf),
}


@pytest.fixture(params=ON_NODES)
def on_nodes(request: pytest.FixtureRequest) -> Callable[[TransitionGraph], NodeKernel]:
    return ON_NODES[request.param]


def ridge(x: Tensor) -> Tensor:
    """A function with a jump."""
    return torch.where(x[..., 0] > 0.2 * x[..., 1], 1.0, -1.0).double() + 0.3 * x.sum(-1)


def agree(gp: SparseOnlineGP, inputs: Tensor, targets: Tensor) -> None:
    """The online posterior is that of a dense refit on all data under the kernel as it is now."""
    queries = torch.cat([inputs[:3], torch.randn(8, 2, dtype=torch.float64)])
    dense = ExactGP(gp.kernel, NOISE).fit(inputs, targets).posterior(queries)
    found = gp.posterior(queries)
    torch.testing.assert_close(found.mean, dense.mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(found.variance, dense.variance, rtol=0, atol=1e-8)


@pytest.mark.parametrize("rule", [NearestEdges(3), ThresholdEdges(0.7)])
def test_after_every_insertion_the_posterior_is_that_of_a_dense_refit(
    on_nodes: Callable[[TransitionGraph], NodeKernel], rule: NearestEdges | ThresholdEdges
):
    graph = TransitionGraph(2, 30, rule)
    gp = SparseOnlineGP(on_nodes(graph), 24, NOISE, novelty_threshold=0)
    inputs = torch.rand(24, 2, dtype=torch.float64) * 2 - 1
    targets = ridge(inputs)
    with torch.no_grad():
        for count in range(1, 25):
            gp.update(inputs[count - 1 : count], targets[count - 1 : count])
            graph.follow(gp.basis, gp.mask)  # old paths get shorter, and the kernel with them
            assert int(graph.size) == int(gp.size) == count
            agree(gp, inputs[:count], targets[:count])


@pytest.mark.parametrize(
    "make",
    [
        lambda experience: GeodesicKernel(experience, 0.9),
        lambda experience: SuccessorKernel(experience, 0.9, 0.5, 1.0, 3) + Matern(2, smoothness=0.5),
    ],
    ids=["geodesic", "successor"],
)
def test_experience_may_grow_between_updates(make: Callable[[Experience], GeodesicKernel]):
    experience = Experience(2, 60, 20)
    gp = SparseOnlineGP(make(experience), 50, NOISE, novelty_threshold=0)
    inputs, targets = torch.empty(0, 2, dtype=torch.float64), torch.empty(0, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(4):
            path = [torch.randn(1, 2, dtype=torch.float64)]
            for _ in range(10):
                path.append(path[-1] @ ROTATION.mT)
            states = torch.cat(path)
            experience.add(states[:-1], states[1:])
            gp.update(states[:-1], ridge(states[:-1]))
            inputs, targets = torch.cat([inputs, states[:-1]]), torch.cat([targets, ridge(states[:-1])])
            assert int(gp.size) == len(inputs)  # every point is in the basis
            agree(gp, inputs, targets)


def test_on_a_long_stream_no_variance_is_negative_and_the_jump_is_learned(
    on_nodes: Callable[[TransitionGraph], NodeKernel],
):
    graph = TransitionGraph(2, 50, NearestEdges(4))
    gp = SparseOnlineGP(on_nodes(graph), 40, NOISE, novelty_threshold=0.3)
    queries = torch.rand(300, 2, dtype=torch.float64) * 2 - 1
    with torch.no_grad():
        for _ in range(25):
            inputs = torch.rand(40, 2, dtype=torch.float64) * 2 - 1
            gp.update(inputs, ridge(inputs))
            graph.follow(gp.basis, gp.mask)
            mean, variance = gp(queries)
            assert (variance > 0).all()
            assert (variance <= 1 + 1e-9).all()
    assert int(gp.size) >= 40  # full, and pruned many times
    assert float((mean - ridge(queries)).square().mean().sqrt()) < 0.55 * float(ridge(queries).std())


def test_hyper_parameters_of_a_mixture_are_fitted_by_marginal_likelihood():
    graph = TransitionGraph(2, 40, NearestEdges(4))
    graph.add(torch.rand(30, 2, dtype=torch.float64) * 2 - 1)
    gp = SparseOnlineGP(ShortestPathKernel(graph, 3.0, interpolate=4) + Matern(2, 3.0), 40, NOISE)
    inputs = torch.rand(80, 2, dtype=torch.float64) * 2 - 1
    before = [parameter.detach().clone() for parameter in gp.kernel.parameters()]
    dense = ExactGP(gp.kernel, NOISE).fit(inputs, ridge(inputs))
    likelihood = float(dense.log_marginal_likelihood().detach())
    assert bool(fit_hyperparameters(gp, inputs, ridge(inputs), steps=20))
    assert float(dense.log_marginal_likelihood().detach()) > likelihood + 5
    assert all(not torch.equal(old, new) for old, new in zip(before, gp.kernel.parameters(), strict=True))


def test_a_saved_process_brings_its_graph_along():
    def make() -> SparseOnlineGP:
        return SparseOnlineGP(ShortestPathKernel(TransitionGraph(2, 40, NearestEdges(4)), 0.7), 30, NOISE)

    saved, loaded = make(), make()
    inputs, queries = torch.randn(25, 2, dtype=torch.float64), torch.randn(9, 2, dtype=torch.float64)
    kernel = saved.kernel
    assert isinstance(kernel, ShortestPathKernel)
    with torch.no_grad():
        saved.update(inputs, ridge(inputs))
        kernel.graph.follow(saved.basis, saved.mask)
        loaded(queries)  # everything derived is there, and has to go
        loaded.load_state_dict(saved.state_dict())
        for found, expected in zip(loaded(queries), saved(queries), strict=True):
            torch.testing.assert_close(found, expected)
