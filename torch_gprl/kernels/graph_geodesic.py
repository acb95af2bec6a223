"""Covariance along experience: how far two states lie apart on trajectories and between neighbours.

σ² exp(−distance) on visited states, with edges in time as long as the discount says (see `geodesics`).
Landmarks stand for all vertices: their correlation matrix is made positive once, every other vertex is what
they say of it, and an input off the graph borrows from the vertices near it.
"""

import math

import torch
from torch import Tensor

from torch_gprl.graphs.experience import Experience
from torch_gprl.graphs.geodesics import Geodesics, geodesics
from torch_gprl.graphs.interpolation import neighbours
from torch_gprl.kernels.graph import Factors, GraphKernel, Table
from torch_gprl.kernels.parameters import PositiveValue
from torch_gprl.linalg import cholesky

SMALLEST_SHIFT = 1e-8  # of the diagonal of landmarks: two of them may be copies of one state


class GeodesicKernel(GraphKernel):
    """Equation (.19) in Laplacian form on all visited states, with edges in time of length ℓ ln(1/discount).

    Args:
        experience: visited states and transitions; may grow at any time.
        discount: γ of the values that are learned, between 0 and 1.
        lengthscale: ℓ, as `GraphKernel`; shortest paths are found anew when it changes, and its gradient is
            that of the paths as they are, which is exact (the envelope theorem).
        outputscale: σ², as `GraphKernel`.
        spatial_edges: nearest states that each state is joined to.

    Raises:
        ValueError: a discount outside (0, 1), or no edges.
    """

    def __init__(
        self,
        experience: Experience,
        discount: float,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        spatial_edges: int = 8,
    ) -> None:
        batch = experience.states.shape[:-2]
        super().__init__(experience.states.shape[-1], lengthscale, outputscale, batch)
        check_discount(discount)
        if not 1 <= spatial_edges < experience.capacity:
            raise ValueError(
                f"spatial_edges must be at least 1 and below the capacity {experience.capacity}, "
                f"got {spatial_edges}"
            )
        self.experience = experience
        self.step_length = math.log(1 / discount)
        self.spatial_edges = spatial_edges

    def _build_table(self) -> Table:
        """Features of every vertex [*batch, C, L], of norm one at most."""
        visited = self.experience
        if int(visited.size) == 0:
            return (
                visited.states.new_zeros(*self.batch_shape, visited.capacity, visited.landmarks.shape[-1]),
            )
        to_landmarks = (-self._distances()).exp()  # [*batch, L, C]
        index = visited.landmarks.unsqueeze(-2).expand(*to_landmarks.shape[:-1], -1)
        features = torch.linalg.solve_triangular(
            _shifted_factor(to_landmarks.gather(-1, index)), to_landmarks, upper=False
        ).mT
        # where landmarks contradict each other, a vertex may end up with more than its variance
        return (features / features.norm(dim=-1, keepdim=True).clamp_min(1),)

    def _build_features(self, x: Tensor, table: Table) -> Factors:
        found = self.experience.nearest(x)
        decay = (-found.distance / self.lengthscale[..., None, None]).exp()
        features = found._replace(weight=found.weight * decay).average(table[0])
        return features, features

    def _distances(self) -> Tensor:
        """Path lengths from landmarks to vertices in units of ℓ [*batch, L, C], differentiable in ℓ."""
        lengthscale = self.lengthscale[..., None, None]
        found = [self._geodesics(learner) for learner in range(self.batch_shape.numel())]
        shape = *self.batch_shape, *found[0].distance.shape
        distance = torch.stack([paths.distance for paths in found]).reshape(shape)
        in_time = torch.stack([paths.steps for paths in found]).reshape(shape) * self.step_length
        in_space = (distance - in_time) * lengthscale.detach()
        reached = distance.isfinite()
        return torch.where(reached, in_space.where(reached, 0.0) / lengthscale + in_time, torch.inf)

    def _geodesics(self, learner: int) -> Geodesics:
        visited, used = self.experience, slice(int(self.experience.size))
        states = visited.states / visited.lengthscale.unsqueeze(-2)
        states = states.reshape(-1, visited.capacity, self.input_dim)[learner, used]
        after = visited.after_nodes.reshape(-1, visited.capacity, visited.interpolate)[learner, used, 0]
        goes_on = (~visited.ends.reshape(-1, visited.capacity)[learner, used]).nonzero().flatten()
        everywhere = torch.ones(states.shape[:-1], dtype=torch.bool, device=states.device)
        near = neighbours(states, states, everywhere, min(self.spatial_edges + 1, states.shape[-2]))
        temporal = torch.stack([goes_on, after[goes_on]], -1)
        length = near.distance / self.lengthscale.detach().reshape(-1)[learner]
        landmarks = visited.landmarks.reshape(-1, visited.landmarks.shape[-1])[learner]
        paths = geodesics((near.nodes, length), temporal, self.step_length, landmarks)
        missing = visited.capacity - states.shape[-2]
        return Geodesics(
            torch.nn.functional.pad(paths.distance, (0, missing), value=torch.inf),
            torch.nn.functional.pad(paths.steps, (0, missing)),
        )


def _shifted_factor(correlation: Tensor) -> Tensor:
    """Cholesky factor of a correlation that may be indefinite, its diagonal raised until it is positive.

    Clipping would not do: what other vertices have along the clipped directions would be divided by nothing.
    """
    smallest = torch.linalg.eigvalsh(correlation.detach())[..., :1]
    shift = (-2 * smallest).clamp_min(SMALLEST_SHIFT)
    return cholesky(correlation + torch.diag_embed(shift.expand(correlation.shape[:-1])))


def check_discount(discount: float) -> None:
    """ValueError for a discount outside (0, 1)."""
    if not 0 < discount < 1:
        raise ValueError(f"discount must lie between 0 and 1, got {discount}")
