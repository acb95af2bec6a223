"""Whole functions drawn from the posterior of a sparse GP: pathwise conditioning.

Wilson et al. (2020), "Efficiently sampling functions from Gaussian process posteriors": a function g of the
prior, made of random Fourier features, and what the basis says against it,

    f(x) = g(x) + φ(x)ᵀ (w − L⁻¹ g(X_B)),   w = A⁻¹b + R⁻ᵀε,   A = R Rᵀ,   ε ~ N(0, I).

With φ = L⁻¹k and w in the whitened coordinates of `whitened`, the second term has the posterior's law at the
basis, and the first carries what the basis misses of x: far from all data f is the prior again. A path is one
function for all inputs, unlike a draw of the joint posterior, which is one for the inputs it was drawn at.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.gp.sparse_online import SparseOnlineGP
from torch_gprl.gp.whitened import solve_triangular
from torch_gprl.kernels import Columns, Kernel, Matern, SquaredExponential
from torch_gprl.kernels.base import Product


class Paths(NamedTuple):
    """E functions of each learner, by their coefficients; they hold until the GP learns."""

    features: Float[Tensor, "*batch E F2"]
    basis: Float[Tensor, "*batch E B"]


class Factor(NamedTuple):
    """A factor of a kernel, the columns of the inputs that it sees, and frequencies from its spectrum."""

    kernel: SquaredExponential | Matern
    columns: tuple[int, ...]
    frequencies: Float[Tensor, "*batch F d"]  # for unit length scales


class PathSampler:
    """Draws functions from a GP's posterior as it stands, from given normal numbers.

    The same numbers give the same random function, seen in the light of more data once the GP has learned.

    Args:
        gp: the process; its kernel is a squared exponential, a Matérn, or a product of such on any columns.
        features: random frequencies; the prior's covariance is off by about one over their root.
        generators: of the frequencies, one for each entry of the flattened batch shape.

    Raises:
        TypeError: another kernel, whose spectrum is not known here.
    """

    def __init__(self, gp: SparseOnlineGP, features: int, generators: Sequence[torch.Generator]) -> None:
        self.gp, self.features = gp, features
        self.factors = [
            Factor(kernel, columns, _unit_frequencies(kernel, features, gp.batch_shape, generators))
            for kernel, columns in _stationary_factors(gp.kernel, tuple(range(gp.kernel.input_dim)))
        ]

    @property
    def random_numbers(self) -> int:
        """Standard normal numbers that a function takes."""
        return 2 * self.features + self.gp.capacity

    @torch.no_grad()
    def draw(self, normal: Float[Tensor, "*batch E R"]) -> Paths:
        """E functions for each learner, from as many normal numbers each as `random_numbers` says."""
        solved, active = self.gp._solved(), self.gp._active()
        features, ε = normal.to(active.basis).tensor_split((2 * self.features,), -1)
        ε = ε[..., : active.rows].mT
        w = solved.weights.unsqueeze(-1) + solve_triangular(solved.precision_factor.mT, ε, upper=True)
        at_basis = self._features(active.basis) @ features.mT
        mask = 1.0 if active.mask is None else active.mask
        against = w - solve_triangular(active.gram_factor, at_basis * mask)
        basis = solve_triangular(active.gram_factor.mT, against * mask, upper=True)
        return Paths(features, basis.mT)

    def values(self, paths: Paths, inputs: Float[Tensor, "*batch E P D"]) -> Float[Tensor, "*batch E P"]:
        """Each function at P inputs of its own, differentiable in them."""
        flat, points = inputs.to(self.gp.basis.dtype).flatten(-3, -2), inputs.shape[-3:-1]
        prior = self._features(flat).unflatten(-2, points)
        cross = self.gp._active().cross(flat).mT.unflatten(-2, points)
        return (prior @ paths.features.unsqueeze(-1) + cross @ paths.basis.unsqueeze(-1)).squeeze(-1)

    def _features(self, inputs: Float[Tensor, "*batch N D"]) -> Float[Tensor, "*batch N F2"]:
        """Features whose products average to the kernel: √(σ²/F) (cos ωᵀx, sin ωᵀx)."""
        phase = sum(  # the spectrum of a product is that of a sum of independent frequencies
            (inputs[..., list(columns)] / kernel.lengthscale.unsqueeze(-2)) @ frequencies.to(inputs).mT
            for kernel, columns, frequencies in self.factors
        )
        assert isinstance(phase, Tensor)
        amplitude = (self.gp.kernel.diag(inputs) / self.features).sqrt().unsqueeze(-1)
        return amplitude * torch.cat([phase.cos(), phase.sin()], -1)


def _stationary_factors(
    kernel: Kernel, columns: tuple[int, ...]
) -> Iterator[tuple[SquaredExponential | Matern, tuple[int, ...]]]:
    """The factors of a kernel that sees the given columns of the whole inputs."""
    if isinstance(kernel, SquaredExponential | Matern):
        yield kernel, columns
    elif isinstance(kernel, Columns):
        yield from _stationary_factors(kernel.kernel, tuple(columns[i] for i in kernel.columns))
    elif isinstance(kernel, Product):
        for part in kernel.parts:
            assert isinstance(part, Kernel)
            yield from _stationary_factors(part, columns)
    else:
        raise TypeError(
            "sample paths need SquaredExponential or Matern kernels, or products, got "
            f"{type(kernel).__name__}; gp.joint(inputs) draws values at given inputs for any kernel"
        )


def _unit_frequencies(
    kernel: SquaredExponential | Matern,
    count: int,
    batch_shape: torch.Size,
    generators: Sequence[torch.Generator],
) -> Float[Tensor, "*batch F d"]:
    """Frequencies from the spectrum of the kernel of unit length scales.

    Normal for a squared exponential; for Matérn ν Student's t of 2ν degrees of freedom: Rasmussen and
    Williams (2006), section 4.2.1.
    """
    drawn = _normal(generators, count, kernel.input_dim)
    if isinstance(kernel, Matern):
        freedom = round(2 * kernel.smoothness)
        square = _normal(generators, count, freedom).square().sum(-1, keepdim=True)
        drawn = drawn * (freedom / square).sqrt()
    return drawn.reshape(*batch_shape, count, kernel.input_dim)


def _normal(
    generators: Sequence[torch.Generator], rows: int, columns: int
) -> Float[Tensor, "G rows columns"]:
    return torch.stack([torch.randn(rows, columns, generator=g, dtype=torch.float64) for g in generators])
