"""Kernels on the nodes of a `TransitionGraph`: shortest paths (.19 to .21), and the spectrum of the graph.

The node matrix G is a function of the graph, of unit diagonal and positive semi-definite. An input x off the
graph has the features F(x) = Σ_i w_i(x) decay(|x − x_i|) G^½_i, its weights w those of the nearest nodes. One
neighbour is equation (.20), more are (.21), with both legs in the same unit as the path and weights that sum
to one (as printed, .20 has one leg and .21 is largest far from all data).
"""

import math
from abc import abstractmethod
from typing import Literal

import torch
from torch import Tensor

from torch_gprl.graphs.interpolation import neighbours
from torch_gprl.graphs.transition import TransitionGraph
from torch_gprl.kernels.graph import Factors, GraphKernel, Table
from torch_gprl.kernels.graph_psd import repaired_correlation
from torch_gprl.kernels.parameters import PositiveValue

SHORTEST_EDGE = 1e-6  # conductance of an edge is 1/length²; copies of one point are this far apart


class NodeKernel(GraphKernel):
    """A kernel given on the nodes of a graph, and carried from them to all other inputs.

    With the basis of a Gaussian process as nodes, `kernel.graph.follow(gp.basis, gp.mask)` after its updates
    lets the graph grow and shrink with it; the process notices by itself.

    Args:
        graph: one graph for each learner of its batch; may grow and shrink at any time.
        lengthscale: ℓ, in units of the inputs; broadcasts to the batch of the graph.
        outputscale: σ², prior variance; broadcasts to the batch of the graph.
        interpolate: nodes that an input off the graph borrows from: 1 for equation (.20), more for (.21).
    """

    def __init__(
        self,
        graph: TransitionGraph,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        interpolate: int = 1,
    ) -> None:
        super().__init__(graph.points.shape[-1], lengthscale, outputscale, graph.size.shape)
        if not 1 <= interpolate < graph.capacity:
            raise ValueError(
                f"interpolate must be at least 1 node and below the capacity {graph.capacity}, "
                f"got {interpolate}"
            )
        self.graph = graph
        self.interpolate = interpolate

    @abstractmethod
    def node_correlation(self) -> Tensor:
        """G [*batch, C, C], of unit diagonal; identity rows where unused."""

    def decay(self, distance: Tensor) -> Tensor:
        """Correlation left after a leg of this length, on which no graph helps."""
        return (-distance / self.lengthscale[..., None, None]).exp()

    def _build_table(self) -> Table:
        return (self.node_correlation(),)

    def _build_features(self, x: Tensor, table: Table) -> Factors:
        found = neighbours(x, self.graph.points, self.graph.mask, self.interpolate)
        weight = found.weight * self.decay(found.distance)
        nodes = weight.new_zeros(*weight.shape[:-1], self.graph.capacity)
        nodes = nodes.scatter(-1, found.nodes, weight)  # Σ w decay, one column for each node
        return nodes @ table[0], nodes

    def _with_identity(self, matrix: Tensor) -> Tensor:
        used = self.graph.mask.unsqueeze(-1) & self.graph.mask.unsqueeze(-2)
        return torch.where(
            used, matrix, torch.eye(self.graph.capacity, dtype=matrix.dtype, device=matrix.device)
        )


class ShortestPathKernel(NodeKernel):
    """Equation (.19): σ² exp(−P/ℓ) or σ² exp(−P²/2ℓ²) in the length P of the shortest path.

    Neither is positive semi-definite on every graph: negative eigenvalues are set to zero, once for each
    change of graph or lengthscale. The Laplacian form needs it little, on a tree not at all.

    Args:
        graph: as `NodeKernel`.
        lengthscale: as `NodeKernel`.
        outputscale: as `NodeKernel`.
        interpolate: as `NodeKernel`.
        shape: `"laplacian"` or `"gaussian"`.

    Raises:
        ValueError: another shape.
    """

    def __init__(
        self,
        graph: TransitionGraph,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        interpolate: int = 1,
        shape: Literal["laplacian", "gaussian"] = "laplacian",
    ) -> None:
        super().__init__(graph, lengthscale, outputscale, interpolate)
        if shape not in ("laplacian", "gaussian"):
            raise ValueError(f"shape must be 'laplacian' or 'gaussian', got {shape!r}")
        self.shape = shape

    def decay(self, distance: Tensor) -> Tensor:
        """Correlation at this distance, of paths and of legs alike."""
        ratio = distance / self.lengthscale[..., None, None]
        return (-ratio if self.shape == "laplacian" else -0.5 * ratio.square()).exp()

    def node_correlation(self) -> Tensor:
        """The repaired matrix of exp(−P/ℓ), or of exp(−P²/2ℓ²): [*batch, C, C]."""
        paths = self.graph.paths
        # no path, no correlation; written so, for infinity has no derivative
        correlation = self.decay(paths.where(paths.isfinite(), 0.0)) * paths.isfinite()
        return repaired_correlation(self._with_identity(correlation))


class GraphMatern(NodeKernel):
    """Matérn and heat kernels of the graph Laplacian Δ: (2ν/ℓ² + Δ)^−ν, and exp(−ℓ²Δ/2) for ν = ∞.

    Borovitskiy et al. (2021), "Matérn Gaussian processes on graphs". Edges conduct 1/length², as in finite
    differences, so that ℓ has the unit of the inputs. Scaled to the prior variance σ² at every node.

    Args:
        graph: as `NodeKernel`.
        lengthscale: as `NodeKernel`.
        outputscale: as `NodeKernel`.
        interpolate: as `NodeKernel`.
        smoothness: ν > 0; infinity for the heat kernel.

    Raises:
        ValueError: a smoothness that is not positive.
    """

    def __init__(
        self,
        graph: TransitionGraph,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        interpolate: int = 1,
        smoothness: float = 1.5,
    ) -> None:
        super().__init__(graph, lengthscale, outputscale, interpolate)
        if not smoothness > 0:
            raise ValueError(f"smoothness must be positive, got {smoothness}")
        self.smoothness = smoothness

    def node_correlation(self) -> Tensor:
        """The matrix function of the Laplacian, scaled to a unit diagonal: [*batch, C, C]."""
        lengths = self.graph.lengths.clamp_min(SHORTEST_EDGE)
        conductance = lengths.square().reciprocal()
        conductance.diagonal(dim1=-2, dim2=-1).zero_()
        laplacian = torch.diag_embed(conductance.sum(-1)) - conductance
        eigenvalues, vectors = torch.linalg.eigh(laplacian)
        square = self.lengthscale.square().unsqueeze(-1)
        if math.isinf(self.smoothness):
            spectrum = (-0.5 * square * eigenvalues).exp()
        else:
            ratio = 2 * self.smoothness / square
            spectrum = ((ratio + eigenvalues) / ratio).pow(-self.smoothness)
        matrix = (vectors * spectrum.unsqueeze(-2)) @ vectors.mT
        scale = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
        return self._with_identity(matrix * scale.unsqueeze(-1) * scale.unsqueeze(-2))
