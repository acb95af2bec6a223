"""One learner on the CPU and one point: what one robot asks at every step, in half the time.

With a few hundred basis vectors the calls cost more than the arithmetic, and NumPy's cost a third of torch's.
The arrays here are the memory of the buffers, so that nothing is kept twice. The precision is written through
torch, whose version counter tells that the posterior is out of date.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import get_blas_funcs
from torch import Tensor

from torch_gprl.gp.bounded import BoundedBasis
from torch_gprl.gp.posterior import Posterior
from torch_gprl.gp.whitened import Active, Solved
from torch_gprl.kernels.distance import GaussianBumps
from torch_gprl.kernels.stationary import Stationary

Map = Callable[[np.ndarray], np.ndarray]
# x ↦ F⁻¹x for a triangular F
SOLVE = {np.dtype(name): get_blas_funcs(("trsv",), dtype=name)[0] for name in ("float64", "float32")}


class InUse(NamedTuple):
    """The rows in use as views, without a dimension for learners; R of them."""

    active: Active  # of which these are views
    whole: Tensor  # the precision of all rows, likewise
    covary: Map  # x [D] ↦ k(X_B, x) [R]
    explain: Map  # k(X_B, x) [R] ↦ φ = L⁻¹k [R]
    gram_factor: Tensor  # [R, R]
    precision: Tensor  # [R, R]
    information: Tensor  # [R]
    evidence: np.ndarray  # the evidence's constant, [1]
    observations: np.ndarray  # [1]
    prior: float | None  # the kernel's variance, where it is the same everywhere

    @classmethod
    def of(cls, gp: BoundedBasis) -> "InUse":
        """Those of now; remembered until the basis changes."""
        active, whole, known = gp._active(), gp._buffers["precision"], gp._in_use
        if known is not None and known.active is active and known.whole is whole:
            return known
        rows, kernel = active.rows, gp.kernel
        found = cls(
            active,
            gp.precision,
            _single(active.cross),
            _substitution(active.gram_factor),
            active.gram_factor.view(rows, rows),
            gp.precision.view(gp.capacity, gp.capacity)[:rows, :rows],
            gp.information.view(-1)[:rows],
            gp.evidence_constant.numpy().reshape(-1),
            gp.observations.numpy().reshape(-1),
            float(kernel.outputscale) if isinstance(kernel, Stationary) else None,
        )
        gp._in_use = found
        return found

    def features(self, inputs: Tensor) -> Tensor:
        """φ of inputs [*1, N, D] in columns: [R, N]."""
        cross = self.active.cross(inputs)
        cross = cross if cross.ndim == 2 else cross.view(cross.shape[-2:])
        memory = cross if isinstance(self.active.cross, GaussianBumps) else None  # which nobody else holds
        return torch.linalg.solve_triangular(self.gram_factor, cross, upper=False, out=memory)

    def prior_at(self, gp: BoundedBasis, point: Tensor) -> float:
        """k(x, x)."""
        return float(gp.kernel.diag(point)) if self.prior is None else self.prior


class Reader(NamedTuple):
    """The posterior, ready to be read one point at a time."""

    solved: Solved  # of which this is a view
    whiten: Map  # φ [R] ↦ half of what the data leave of its variance [R]
    weights: np.ndarray  # [R]

    @classmethod
    def of(cls, gp: BoundedBasis, solved: Solved) -> "Reader":
        """That of now; remembered until the posterior changes."""
        known = gp._reader
        if known is None or known.solved is not solved:
            weights = solved.weights.numpy().reshape(-1)
            gp._reader = known = cls(solved, _substitution(solved.precision_factor), weights)
        return known


def posterior(gp: BoundedBasis, point: Tensor) -> Posterior:
    """Mean and variance of f at a point [*1, 1, D], [*1, 1] each, without gradients."""
    solved = gp._solved()  # first: it sees to a changed kernel
    used, reader = InUse.of(gp), Reader.of(gp, solved)
    phi = used.explain(used.covary(point.detach().numpy().reshape(-1)))
    mean = float(phi.dot(reader.weights))
    variance = used.prior_at(gp, point) - float(phi.dot(phi))
    half = reader.whiten(phi)
    variance += float(half.dot(half))
    shape = point.shape[:-1]
    return Posterior(point.new_full(shape, mean), point.new_full(shape, variance))


def _single(cross: Callable[[Tensor], Tensor]) -> Map:
    """What the prepared kernel says of one point [D]: its own short way, or the one of many points."""
    own = getattr(cross, "of_one", None)
    if own is not None:
        return own
    return lambda x: cross(torch.from_numpy(x).unsqueeze(0)).detach().numpy().reshape(-1)


def _substitution(factor: Tensor) -> Map:
    """The map x [R] ↦ F⁻¹x for a lower triangular F [*1, R, R]; it overwrites x."""
    array = factor.numpy().reshape(factor.shape[-2:])
    solve = SOLVE[array.dtype]
    if not len(array):
        return lambda x: x
    if array.flags.f_contiguous:
        return lambda x: solve(array, x, lower=1, overwrite_x=1)
    upper = array.T  # of a matrix in rows, BLAS reads the transpose
    return lambda x: solve(upper, x, lower=0, trans=1, overwrite_x=1)
