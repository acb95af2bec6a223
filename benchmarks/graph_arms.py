"""The kernels that `graph_kernels` compares, and how each is tuned, fed and judged, all in the same way.

Hyper-parameters maximise the marginal likelihood of held-out trajectories: those of the graph kernels are
tuned on a graph that lacks them, since a graph tells more of its own vertices than of new states. Graphs of
visited states are measured in units that a Matérn 1/2 kernel, tuned on the same trajectories, suggests; the
successor kernel takes all its parameters from there. The sparse online process then learns from all
trajectories in random blocks, graphs growing along.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.graph_systems import DISCOUNT, Trajectories
from torch_gprl.gp import Posterior, SparseOnlineGP, fit_hyperparameters
from torch_gprl.graphs import Experience, NearestEdges, ThresholdEdges, TransitionGraph
from torch_gprl.kernels import (
    GeodesicKernel,
    GraphMatern,
    Kernel,
    Matern,
    ShortestPathKernel,
    SquaredExponential,
    SuccessorWithRest,
)

BLOCK = 250  # points of one update
MOST_NODES = 300  # of a graph of basis vectors: a budget with its overshoot
TUNING_NODES = 100
TUNING_POINTS = 300
HELD_OUT = 2  # one trajectory in so many is held out of the graph while its kernel is tuned
NEIGHBOURS = 4
MEMORY = 800  # basis vectors of a Euclidean kernel that remembers about as much as a graph of visited states
PRINTED_THRESHOLD = 0.7
LOOKAHEAD = 20  # steps

Graph = TransitionGraph | Experience | None


@dataclass(frozen=True)
class Arm:
    """One kernel: how to make it, and on what it stands."""

    graph: Callable[[int, int], Graph]  # from input columns and the number of transitions that will be stored
    kernel: Callable[[Graph, int], Kernel]  # from the graph and input columns
    budgets: tuple[int, ...] = ()  # basis vectors, if not those of all


def _nodes(dims: int, transitions: int) -> TransitionGraph:
    return TransitionGraph(dims, MOST_NODES, NearestEdges(NEIGHBOURS))


def _visited(dims: int, transitions: int) -> Experience:
    return Experience(dims, transitions)


def _none(dims: int, transitions: int) -> None:
    return None


def _on_nodes(kernel: Callable[[TransitionGraph], Kernel]) -> Arm:
    def make(graph: Graph, dims: int) -> Kernel:
        assert isinstance(graph, TransitionGraph)
        return kernel(graph)

    return Arm(_nodes, make)


def _on_experience(kernel: Callable[[Experience], Kernel]) -> Arm:
    def make(graph: Graph, dims: int) -> Kernel:
        assert isinstance(graph, Experience)
        return kernel(graph)

    return Arm(_visited, make)


EUCLIDEAN = {
    "squared exponential": Arm(_none, lambda graph, dims: SquaredExponential(dims)),
    "Matérn 1/2": Arm(_none, lambda graph, dims: Matern(dims, smoothness=0.5)),
    "Matérn 3/2": Arm(_none, lambda graph, dims: Matern(dims)),
}
REMEMBERS = Arm(_none, lambda graph, dims: Matern(dims, smoothness=0.5), budgets=(MEMORY,))
ON_GRAPHS = {
    "shortest path, nearest (.20)": _on_nodes(lambda graph: ShortestPathKernel(graph)),
    "shortest path, interpolated (.21)": _on_nodes(
        lambda graph: ShortestPathKernel(graph, interpolate=NEIGHBOURS)
    ),
    "shortest path, Gaussian (.21)": _on_nodes(
        lambda graph: ShortestPathKernel(graph, interpolate=NEIGHBOURS, shape="gaussian")
    ),
    "graph Matérn 3/2": _on_nodes(lambda graph: GraphMatern(graph, interpolate=NEIGHBOURS)),
    "geodesic": _on_experience(lambda visited: GeodesicKernel(visited, DISCOUNT)),
    "successor, no look-ahead": _on_experience(lambda visited: SuccessorWithRest(visited, DISCOUNT, 1.0, 0)),
    "successor": _on_experience(lambda visited: SuccessorWithRest(visited, DISCOUNT)),
}
ARMS = EUCLIDEAN | ON_GRAPHS | {f"Matérn 1/2, {MEMORY} kept": REMEMBERS}


class Tuned:
    """A kernel with hyper-parameters for some trajectories, ready to learn from them at any budget."""

    def __init__(self, arm: Arm, seen: Trajectories, seed: int, steps: int, noise: float) -> None:
        """Tune; `steps` of the optimiser, from a noise variance of `noise`."""
        torch.manual_seed(seed)
        self.seen = seen
        dims = seen.states.shape[-1]
        self.graph = arm.graph(dims, seen.targets.numel())
        self.kernel = arm.kernel(self.graph, dims)
        start = time.perf_counter()
        kept = torch.arange(len(seen.targets)) % HELD_OUT != 0
        held_out, targets = seen.states[~kept].flatten(0, 1), seen.targets[~kept].flatten()
        chosen = torch.randperm(len(targets))[:TUNING_POINTS]

        def fit(kernel: Kernel) -> Tensor:
            gp = SparseOnlineGP(kernel, TUNING_NODES, noise)
            fit_hyperparameters(gp, held_out[chosen], targets[chosen], steps, noise_floor=noise / 4)
            return gp.noise_variance.detach()

        ordinary = Matern(dims, smoothness=0.5)
        if isinstance(self.kernel, SuccessorWithRest):
            grow(self.graph, seen, torch.ones_like(kept))
            self.noise = fit(ordinary)
            self.kernel.suit(ordinary.lengthscale, ordinary.outputscale)
        elif isinstance(self.graph, Experience):
            grow(self.graph, seen, kept)
            fit(ordinary)
            self.graph.measure(self.graph.pulled_back(ordinary.lengthscale.detach(), DISCOUNT))
            self.noise = fit(self.kernel)
            grow(self.graph, seen, ~kept)
        else:
            grow(self.graph, seen, kept)
            self.noise = fit(self.kernel)
        self.seconds = time.perf_counter() - start

    def together(self, budgets: Sequence[int]) -> list[Sequence[int]]:
        """Budgets in groups that can learn at once: a graph of basis vectors is that of one basis alone."""
        return [[budget] for budget in budgets] if isinstance(self.graph, TransitionGraph) else [budgets]

    @torch.no_grad()
    def learn(self, budgets: Sequence[int], seed: int) -> list[SparseOnlineGP]:
        """Processes of so many basis vectors that have learned all trajectories."""
        if isinstance(self.graph, TransitionGraph):
            self.graph.eliminate(self.graph.mask)
        processes = [SparseOnlineGP(self.kernel, budget, self.noise) for budget in budgets]
        order = torch.randperm(self.seen.targets.numel(), generator=torch.Generator().manual_seed(seed))
        states, targets = self.seen.states.flatten(0, 1), self.seen.targets.flatten()
        for rows in order.split(BLOCK):
            block = states[rows]  # one tensor for all, so that kernels need not look at it twice
            for gp in processes:
                gp.update(block, targets[rows])
                if isinstance(self.graph, TransitionGraph):
                    self.graph.follow(gp.basis, gp.mask)
        return processes


def grow(graph: Graph, seen: Trajectories, which: Tensor) -> None:
    """Store trajectories in a graph; a graph of basis vectors gets some of their states, spread out."""
    if graph is None:
        return
    states, next_states = seen.states[which].flatten(0, 1), seen.next_states[which].flatten(0, 1)
    if isinstance(graph, Experience):
        graph.add(states, next_states)
    else:
        spread = Experience(states.shape[-1], len(states), TUNING_NODES)
        spread.add(states, next_states)
        graph.add(states[spread.landmarks])


def printed(
    seen: Trajectories, queries: Float[Tensor, "N D"], extension: str, noise: float, nodes: int
) -> Posterior:
    """Equations (.18) to (.21) to the letter: squared edges, Gaussian of P, one leg, raw weights.

    The matrix is not positive semi-definite, and a process on it has negative variances: what remains is
    least squares on k(x, ·) at the nodes, with its residual variance everywhere.

    Args:
        seen: data.
        queries: where to predict.
        extension: ".20" or ".21".
        noise: ridge of least squares.
        nodes: basis vectors, spread out over the states.
    """
    dims = seen.states.shape[-1]
    graph = TransitionGraph(dims, nodes, ThresholdEdges(PRINTED_THRESHOLD, squared=True))
    visited = Experience(dims, seen.targets.numel(), nodes)
    states, targets = seen.states.flatten(0, 1), seen.targets.flatten()
    visited.add(states, seen.next_states.flatten(0, 1))
    graph.add(states[visited.landmarks])
    # no path is no correlation; the sum of (.21) needs a number for it, and takes the longest path
    paths = graph.paths.where(graph.paths.isfinite(), graph.paths[graph.paths.isfinite()].max())

    def covariance(x: Tensor) -> Tensor:
        square = torch.cdist(x, graph.points).square()
        if extension == ".20":
            leg, nearest = square.min(-1)
            length = leg.unsqueeze(-1) + paths[nearest]
        else:
            length = (-square / 2).exp() @ paths
        return (-length.square() / 2).exp()

    K = covariance(states)
    eye = torch.eye(nodes, dtype=K.dtype)
    weights = torch.linalg.solve(K.mT @ K + noise * eye, K.mT @ targets)
    variance = (K @ weights - targets).square().mean()
    return Posterior(covariance(queries) @ weights, variance.expand(len(queries)))
