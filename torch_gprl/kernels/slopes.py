"""Radial kernels with their slopes, from one evaluation: what gradients and curvatures of a GP mean need.

A radial kernel is a function of u = Σ_d (x_d − z_d)²/2ℓ_d². With its derivatives k' and k'' in u,

    ∂k/∂x_d = k' (x_d − z_d)/ℓ_d²,     ∂²k/∂x_d² = k'' (x_d − z_d)²/ℓ_d⁴ + k'/ℓ_d²

    squared exponential   k = σ² exp(−u),                    k' = −k,                        k'' = k
    Matérn 5/2            k = σ² (1 + t + t²/3) exp(−t),     k' = −(5/3) σ² (1 + t) exp(−t),
                          t = √(10 u)                        k'' = (25/3) σ² exp(−t)
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.kernels.distance import log_gaussian
from torch_gprl.kernels.stationary import Matern, SquaredExponential, Stationary
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs


class Radial(NamedTuple):
    """A kernel's values between two sets of points, and its first two derivatives in u."""

    value: CrossMatrix
    first: CrossMatrix
    second: CrossMatrix


def radial(kernel: Stationary, x: Inputs, z: OtherInputs) -> Radial:
    """Values and radial derivatives of a kernel at x [*batch, N, D] and z [*batch, M, D].

    Raises:
        ValueError: a kernel that is not twice differentiable, or not known here.
    """
    if isinstance(kernel, SquaredExponential):
        value = kernel(x, z)
        return Radial(value, -value, value)
    if not (isinstance(kernel, Matern) and kernel.smoothness == 2.5):
        raise ValueError(
            f"slopes are known for SquaredExponential and Matern(smoothness=2.5), not for {kernel}"
        )
    minus_u = log_gaussian(x, z, kernel.log_lengthscale)
    t = minus_u.mul(-10).clamp_min(0).sqrt()  # a few epsilons below 0 are roundoff
    decay = (kernel.log_outputscale[..., None, None] - t).exp()
    tilted = torch.addcmul(decay, t, decay)  # (1 + t) exp(−t)
    return Radial(torch.addcmul(tilted, t * t, decay, value=1 / 3), tilted * (-5 / 3), decay * (25 / 3))


def mean_slopes(
    between: Radial,
    weights: Float[Tensor, "*batch M"],
    x: Float[Tensor, "*batch N A"],
    z: Float[Tensor, "*batch M A"],
    lengthscale: Float[Tensor, "*#batch A"],
) -> tuple[Float[Tensor, "*batch N A"], Float[Tensor, "*batch N A"]]:
    """Gradient and second derivatives of f(x) = k(x, z) α in some columns of x.

    Args:
        between: of the points, in all columns.
        weights: α.
        x: the columns of interest of the points.
        z: the same columns of the basis.
        lengthscale: of these columns.
    """
    unit = lengthscale.square().unsqueeze(-2)
    ones, linear = weights.unsqueeze(-1), weights.unsqueeze(-1) * z
    columns = z.shape[-1]
    # Σ_j α_j k'_j (x − z_j) and Σ_j α_j k''_j (x − z_j)², by powers of z
    first = between.first @ torch.cat([ones, linear], -1)
    second = between.second @ torch.cat([ones, linear, linear * z], -1)
    gradient = (x * first[..., :1] - first[..., 1:]) / unit
    square = x.square() * second[..., :1] - 2 * x * second[..., 1 : 1 + columns] + second[..., 1 + columns :]
    return gradient, square / unit.square() + first[..., :1] / unit
