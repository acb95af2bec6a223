"""The prior that rewards and transitions give to values: V = (I − γP)⁻¹ r, hence K = M K_r Mᵀ.

With M = (I − γP)⁻¹ over visited states and a squared exponential K_r on rewards, two states covary as much as
what follows them does: values may jump between neighbours that part, and agree where trajectories merge.
Directed, and positive semi-definite by construction. The features M φ are Dayan's (1993) successor
representation; as a prior of values it is that of Engel et al. (2005) with the transitions known.

Inputs off the graph are followed ahead: x, its expected successor, and so on, for some steps before the last
one borrows from the vertices near it. That is what finds the side of a ridge on which an input lies. It is a
hard decision, which one trajectory more or less may turn round. So a committee takes it, each member of which
lacks a fold of the trajectories (Parmanto, Munro and Doyle, 1996) and looks ahead another time. Where its
members, or the vertices that they end at, disagree, the variance that the average loses is kept, and so is a
part of that of the vertices nearest to the input itself: near a ridge the prior stays wide, and with `unseen`
far from all vertices too. Inputs on the graph went where they went.

| paper | here | meaning |
|---|---|---|
| φ | `_reward_features` | K_r(x, Z) L⁻ᵀ, on landmarks Z with K_r(Z, Z) = LLᵀ |
| Mφ | `vertices` | expected discounted sum of φ from each visited state on |
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor
from torch.autograd.function import FunctionCtx

from torch_gprl.graphs.experience import Experience
from torch_gprl.graphs.interpolation import COINCIDENT, Neighbours
from torch_gprl.kernels.distance import log_gaussian
from torch_gprl.kernels.graph import SMALLEST_REST, Factors, Remembered, Table, TableKernel, exponential
from torch_gprl.kernels.graph_geodesic import check_discount
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter
from torch_gprl.linalg import cholesky
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint

FIRST_DOUBT = 0.1  # until it is set or fitted
AHEAD = (0.5, 1.0, 2.0)  # how far members of the committee follow, in parts of the lookahead
WAYS = 2  # to divide the trajectories into folds, each of which one member lacks


class Way(NamedTuple):
    """Where inputs are expected to go, whatever the parameters are."""

    points: list[Float[Tensor, "*batch N D"]]  # of each step: x, its successor, and so on
    weights: list[Float[Tensor, "*batch N"]]  # γ^t times the part that has not ended; of one step more
    end: Neighbours  # of the point that the last step reaches


class Ways(NamedTuple):
    """How inputs stand to the graph, and where those off it go."""

    start: Neighbours
    off: Bool[Tensor, "*batch N"]  # the graph
    rows: Int[Tensor, " R"]  # off the graph for some learner
    committee: list[Way]  # of these rows, one from each member; none for no rows


class SuccessorKernel(TableKernel):
    """σ² ((Mφ)(x) (Mφ)(z)ᵀ + what is undecided), of mean prior variance σ² over visited states.

    It tells nothing where there is no experience, and the transitions of others are a guess: add an ordinary
    kernel, `SuccessorKernel(…) + Matern(…)`, for what it cannot tell. A further parameter, `doubt`, is the
    part of the disagreement of the nearest states that following an input ahead does not settle. A visited
    state keeps its vertex: there the kernel is no smooth function of its inputs.

    Args:
        experience: visited states and transitions; may grow at any time.
        discount: γ of the values that are learned, between 0 and 1.
        lengthscale: of rewards, in units of the inputs; broadcasts to [*batch, D].
        outputscale: σ², prior variance of values; broadcasts to [*batch].
        lookahead: steps that an input off the graph is followed before it borrows from vertices, by a
            third of the committee; half as many by another, twice as many by the last.
        unseen: variance in parts of σ² that inputs far from all visited states have besides, of which a
            visited state at a distance of d leaves 1 − exp(−2 d), as with a Matérn 1/2 kernel.

    Raises:
        ValueError: a discount outside (0, 1), a negative lookahead or variance.
    """

    lengthscale = Positive()
    outputscale = Positive()
    doubt = Positive()
    unseen: Float[Tensor, ""]

    def __init__(
        self,
        experience: Experience,
        discount: float,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        lookahead: int = 20,
        unseen: float = 0.0,
    ) -> None:
        batch, dims = experience.states.shape[:-2], experience.states.shape[-1]
        super().__init__(dims, batch)
        check_discount(discount)
        if lookahead < 0:
            raise ValueError(f"lookahead must be at least 0 steps, got {lookahead}")
        if unseen < 0:
            raise ValueError(f"unseen must be a variance of at least 0, got {unseen}")
        self.log_lengthscale = log_parameter(lengthscale, "lengthscale", (*batch, dims))
        self.log_outputscale = log_parameter(outputscale, "outputscale", batch)
        self.log_doubt = log_parameter(FIRST_DOUBT, "doubt", batch)
        self.register_buffer("unseen", experience.states.new_tensor(unseen))
        self.experience = experience
        self.discount = discount
        self.lookahead = lookahead
        self._remembered_ways: Remembered[Ways] = Remembered()

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        features, rest = self.features(x)
        others, other_rest = (features, rest) if z is x else self.features(z)
        undecided = rest @ other_rest.mT * exponential(x, z, self.log_lengthscale)
        return self.outputscale[..., None, None] * (features @ others.mT + undecided)

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        features, rest = self.features(x)
        return self.outputscale.unsqueeze(-1) * (features.square().sum(-1) + rest.squeeze(-1).square())

    def _sources_of_table(self) -> list[Tensor]:
        """Amplitudes come after the table."""
        return [self.log_lengthscale, *self.buffers()]

    def _build_table(self) -> Table:
        """Landmarks, the inverse of their factor, and Mφ of every vertex [*batch, C, L], all scaled."""
        visited = self.experience
        index = visited.landmarks.unsqueeze(-1).expand(*visited.landmarks.shape, self.input_dim)
        landmarks = visited.states.gather(-2, index)
        factor = cholesky(log_gaussian(landmarks, landmarks, self.log_lengthscale).exp())
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
        used = visited.mask.unsqueeze(-1)
        values = self._vertices(landmarks, inverse) * used
        variance = values.square().sum(-1).sum(-1) / visited.size.clamp_min(1)
        scale = torch.where(variance > 0, variance, torch.inf).rsqrt()[..., None, None]
        return landmarks, inverse * scale, values * scale

    def _vertices(self, landmarks: Tensor, inverse: Tensor) -> Tensor:
        """Mφ of every vertex: Mφ(x) = φ(x) + γ Mφ(x'), the ends of trajectories followed ahead."""
        visited = self.experience
        rewards = self._reward_features(visited.states, landmarks, inverse)
        going = self.discount * (~visited.terminated).to(inverse.dtype)
        rows = visited.ends.reshape(-1, visited.capacity).any(0).nonzero().flatten()  # an end of any learner
        ends = visited.ends[..., rows].unsqueeze(-1)
        ways = self._follow(visited.next_states[..., rows, :])
        nodes, weights = [], []
        for way in ways:
            ahead = going[..., rows].unsqueeze(-1) * ends * self._along(way, landmarks, inverse)
            rewards = rewards.index_add(-2, rows, ahead / len(ways))
            left = way.end.weight * way.weights[-1].unsqueeze(-1)
            nodes.append(_with_rows(visited.after_nodes, rows, ends, way.end.nodes))
            weights.append(_with_rows(visited.after_weights, rows, ends, left) / len(ways))
        return _resolve(torch.cat(nodes, -1), torch.cat(weights, -1) * going.unsqueeze(-1), rewards)

    def _build_features(self, x: Tensor, table: Table) -> Factors:
        """F [*batch, N, L], and the root of the variance that is left undecided [*batch, N, 1]."""
        ways, vertices = self._ways(x), table[-1]
        features, spread_here = _agreement(ways.start, vertices)
        left = 1 - (-2 * ways.start.distance[..., :1]).exp()  # by the nearest visited state
        undecided = self.doubt[..., None, None] * spread_here + self.unseen * left
        if ways.committee:
            off = ways.off[..., ways.rows].unsqueeze(-1)
            followed, disputed = self._followed(ways.committee, table)
            features = _with_rows(features, ways.rows, off, followed)
            undecided = undecided + _with_rows(torch.zeros_like(undecided), ways.rows, off, disputed)
        return features, undecided.clamp_min(SMALLEST_REST).sqrt()

    def _followed(self, ways: list[Way], table: Table) -> tuple[Tensor, Tensor]:
        """Features that all ways lead to on average, and the variance that they disagree about."""
        landmarks, inverse, vertices = table
        found, variance = [], []
        for way in ways:
            left = way.weights[-1].unsqueeze(-1)
            average, spread = _agreement(way.end, vertices)
            found.append(self._along(way, landmarks, inverse) + left * average)
            variance.append(left.square() * spread)
        features, within = torch.stack(found), torch.stack(variance).mean(0)
        average = features.mean(0)
        return average, within + (features - average).square().sum(-1, keepdim=True).mean(0)

    def _ways(self, x: Tensor) -> Ways:
        """The expected ways from x, found once while a fit tries many parameters."""
        if torch.is_grad_enabled() and x.requires_grad:
            return self._find_ways(x)
        return self._remembered_ways.find(x, self.experience.buffers(), self._find_ways)

    def _find_ways(self, x: Tensor) -> Ways:
        start = self.experience.nearest(x)
        off = start.distance[..., 0] > COINCIDENT
        rows = off.reshape(off.shape[:-1].numel(), off.shape[-1]).any(0).nonzero().flatten()
        return Ways(start, off, rows, self._follow(x[..., rows, :]) if len(rows) else [])

    def _follow(self, x: Tensor) -> list[Way]:
        """The way from x by each member of the committee."""
        folds = len(AHEAD)
        return [
            self._follow_among(x, known, int(AHEAD[(fold + way) % folds] * self.lookahead))
            for way in range(WAYS)
            for fold, known in enumerate(self.experience.without_folds(folds, way))
        ]

    def _follow_among(self, x: Tensor, known: Tensor, steps: int) -> Way:
        batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
        here, weight = x, x.new_ones(*batch, x.shape[-2])
        points, weights = [], [weight]
        for _ in range(steps):
            points.append(here)
            here, alive = self.experience.successor(here, known)
            weights.append(weights[-1] * self.discount * alive)
        return Way(points, weights, self.experience.nearest(here, known))

    def _along(self, way: Way, landmarks: Tensor, inverse: Tensor) -> Tensor:
        """Discounted φ along the way, summed up to its last step."""
        total = inverse.new_zeros(*way.weights[0].shape, landmarks.shape[-2])
        for point, weight in zip(way.points, way.weights, strict=False):
            total = total + weight.unsqueeze(-1) * log_gaussian(point, landmarks, self.log_lengthscale).exp()
        return total @ inverse.mT

    def _reward_features(self, x: Tensor, landmarks: Tensor, inverse: Tensor) -> Tensor:
        return log_gaussian(x, landmarks, self.log_lengthscale).exp() @ inverse.mT


def _with_rows(values: Tensor, rows: Tensor, where: Tensor, new: Tensor) -> Tensor:
    """Values [*batch, N, R], with others [*batch, rows, R] in some rows where a mask says so."""
    return values.index_copy(-2, rows, torch.where(where, new, values[..., rows, :]))


def _agreement(found: Neighbours, values: Tensor) -> tuple[Tensor, Tensor]:
    """What vertices say on average [*batch, N, L], and how much they disagree: Σ w |v|² − |Σ w v|²."""
    average = found.average(values)
    norms = found.average(values.square().sum(-1, keepdim=True))
    return average, norms - average.square().sum(-1, keepdim=True)


def _resolve(nodes: Tensor, weights: Tensor, right: Tensor) -> Tensor:
    """(I − T)⁻¹ right [*batch, C, L], with weights T_ij [*batch, C, K] at j = nodes[i]; for each learner."""
    size = right.shape[-2]
    flat = (tensor.reshape(-1, size, tensor.shape[-1]) for tensor in (nodes, weights, right))
    solved = [_solve_sparse(_factorise(n, w), r) for n, w, r in zip(*flat, strict=True)]
    return torch.stack(solved).reshape(right.shape)


def _factorise(nodes: Tensor, weights: Tensor) -> SuperLU:
    size, count = nodes.shape
    rows = np.repeat(np.arange(size), count)
    entries = weights.detach().cpu().double().numpy().ravel(), (rows, nodes.cpu().numpy().ravel())
    going = csc_array(entries, shape=(size, size))
    going.eliminate_zeros()  # most transitions arrive at one vertex, and leave nothing to the others
    return splu(csc_array(eye_array(size) - going))


def _solve_sparse(factor: SuperLU, right: Tensor) -> Tensor:
    solved = _SparseSolve.apply(right, factor)
    assert isinstance(solved, Tensor)
    return solved


class _SparseSolve(torch.autograd.Function):
    """A⁻¹ right for a sparse A that SciPy has factorised, differentiable in the right-hand side."""

    @staticmethod
    def forward(ctx: FunctionCtx, right: Tensor, factor: SuperLU) -> Tensor:
        ctx.factor = factor  # pyright: ignore[reportAttributeAccessIssue]
        return torch.from_numpy(factor.solve(right.detach().cpu().double().numpy())).to(right)

    @staticmethod
    def backward(ctx: FunctionCtx, *gradients: Tensor) -> tuple[Tensor, None]:
        factor: SuperLU = ctx.factor  # pyright: ignore[reportAttributeAccessIssue]
        gradient = gradients[0].detach().cpu().double().numpy()
        return torch.from_numpy(factor.solve(gradient, trans="T")).to(gradients[0]), None
