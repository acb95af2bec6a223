"""A sparse process on a prescribed basis, with all that it knows given at once.

A stream grows its basis as it comes (`SparseOnlineGP.update`). Where all data are kept, the basis is better
chosen among all of them, and the pseudo-likelihood of the basis values u is summed anew whenever targets
change. Gonzalez (1985), "Clustering to minimize the maximum intercluster distance", for the choice; the
state that is written is that of `whitened`.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.gp.sparse_online import SparseOnlineGP
from torch_gprl.gp.whitened import solve_triangular
from torch_gprl.graphs.covering import farthest_points
from torch_gprl.kernels.stationary import Stationary

LEAST_DISTANCE = 0.02  # length scales: nearer points say the same, and ruin the Gram matrix' condition


@torch.no_grad()
def adopt_basis(
    gp: SparseOnlineGP,
    inputs: Float[Tensor, "*batch N D"],
    lengthscale: Float[Tensor, "*#batch D"] | None = None,
) -> None:
    """Forget everything, and make the basis of points that lie farthest from each other.

    Args:
        gp: process whose whole budget is used if the points fill it.
        inputs: points to choose from, [*batch, N, D].
        lengthscale: units of distance, one for each column; those of a stationary kernel unless told.
    """
    if lengthscale is None:
        assert isinstance(gp.kernel, Stationary)
        lengthscale = gp.kernel.lengthscale
    scaled = inputs / lengthscale.unsqueeze(-2)
    index, distance = farthest_points(scaled, gp.budget)
    size = (distance > LEAST_DISTANCE).sum(-1)
    rows = index.shape[-1]
    gp.reset()
    chosen = inputs.gather(-2, index.unsqueeze(-1).expand(*index.shape, inputs.shape[-1]))
    gp.size.copy_(size)
    gp.basis[..., :rows, :] = torch.where(gp.mask[..., :rows, None], chosen, 0.0)
    gp.rebase()  # the Gram factor of the new basis; there is nothing else to keep


@torch.no_grad()
def observe(
    gp: SparseOnlineGP, design: Float[Tensor, "*batch N R"], targets: Float[Tensor, "*batch N"]
) -> None:
    """Learn y = X α + noise, with X the design and α = K⁻¹u the weights of the basis.

    The posterior mean is then k(x, X_B) α with the α that solves (XᵀX/σ0² + K) α = Xᵀy/σ0². What the basis
    misses of an observation counts as explained (the form "dtc").

    Args:
        gp: process whose basis stays; the rows in use come first.
        design: rows of X, one for each observation, for the first R basis vectors; zero where unused.
        targets: y.
    """
    rows, noise = design.shape[-1], gp.noise_variance.unsqueeze(-1)
    # whitened before it is summed: L⁻¹(XᵀX)L⁻ᵀ would lose its digits where K is ill-conditioned
    phi = solve_triangular(gp.gram_factor[..., :rows, :rows], design.mT)
    gp.precision[..., :rows, :rows] += phi @ phi.mT / noise.unsqueeze(-1)
    gp.information[..., :rows] += (phi @ targets.unsqueeze(-1)).squeeze(-1) / noise
    count, noise = targets.shape[-1], gp.noise_variance
    quadratic = targets.square().sum(-1) / noise
    gp.evidence_constant.add_(-0.5 * (quadratic + count * (2 * math.pi * noise).log()))
    gp.observations.add_(count)


def observe_anew(
    gp: SparseOnlineGP, design: Float[Tensor, "*batch N R"], targets: Float[Tensor, "*batch N"]
) -> None:
    """Forget all data, and `observe` these."""
    gp.forget()
    observe(gp, design, targets)
