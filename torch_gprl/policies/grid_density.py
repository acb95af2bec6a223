"""A density on an interval by its values on a grid, linear in between: sampled by its exact inverse.

Everything that is asked of it, its normaliser, inverse, moments, entropy, is that of one and the same
piecewise linear function. Scores therefore have mean zero to the last digit, and samples follow the density
that is differentiated.
"""

# torch declares as properties what its own distributions set as attributes:
# pyright: reportIncompatibleMethodOverride=false, reportAssignmentType=false

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints, register_kl


class GridDensity(Distribution):
    """Piecewise linear density of one number, event shape [1].

    Args:
        log_density: logarithm at the points of an even grid, up to a constant, [*batch, G].
        low, high: ends of the grid, [1] each.
    """

    arg_constraints = {}  # noqa: RUF012  (torch's own convention)
    has_rsample = False

    def __init__(
        self, log_density: Float[Tensor, "*batch G"], low: Float[Tensor, " 1"], high: Float[Tensor, " 1"]
    ) -> None:
        self.low, self.high = low.to(log_density), high.to(log_density)
        points = log_density.shape[-1]
        self.spacing = (self.high - self.low).squeeze(-1) / (points - 1)
        self.grid = torch.linspace(0, 1, points).to(log_density) * (self.high - self.low) + self.low
        peak = log_density.detach().max(-1, keepdim=True).values
        mass = _trapezoid((log_density - peak).exp()).unsqueeze(-1) * self.spacing
        self.log_density = log_density - peak - mass.log()  # normalised
        super().__init__(log_density.shape[:-1], torch.Size([1]), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """The interval."""
        return constraints.independent(constraints.interval(self.low, self.high), 1)

    def log_prob(self, value: Float[Tensor, "*#batch 1"]) -> Float[Tensor, "..."]:
        """Log density at values; minus infinity outside the interval."""
        place = ((value.to(self.low) - self.low) / self.spacing).squeeze(-1)
        place = place.expand(torch.broadcast_shapes(place.shape, self.batch_shape))
        cell = place.floor().clamp(0, self.grid.shape[-1] - 2)
        share, cell = (place - cell).clamp(0, 1), cell.long().unsqueeze(-1)
        lead = (*cell.shape[:-1], self.grid.shape[-1])
        left, right = (self.log_density.expand(lead).gather(-1, cell + step).squeeze(-1) for step in (0, 1))
        inside = torch.logaddexp(left + (-share).log1p(), right + share.log())
        outside = (place < 0) | (place > self.grid.shape[-1] - 1)
        return inside.masked_fill(outside, -torch.inf)

    @torch.no_grad()
    def icdf(self, value: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 1"]:
        """The number below which a share `value` in [0, 1] of the mass lies."""
        density = self.log_density.exp()
        cells = (density[..., :-1] + density[..., 1:]) / 2 * self.spacing
        cumulative = cells.cumsum(-1)
        wanted = value.to(density).clamp(0, 1) * cumulative[..., -1:]
        cell = torch.searchsorted(cumulative, wanted.contiguous()).clamp_max(cells.shape[-1] - 1)
        before = (cumulative - cells).gather(-1, cell)
        left, right = density.gather(-1, cell), density.gather(-1, cell + 1)
        # within the cell: left t + (right − left) t²/2 = (wanted − before)/spacing, without cancellation
        rest = ((wanted - before) / self.spacing).clamp_min(0)
        root = (left.square() + 2 * rest * (right - left)).clamp_min(0).sqrt()
        share = (2 * rest / (left + root).clamp_min(torch.finfo(density.dtype).tiny)).clamp(0, 1)
        return self.low + (cell + share) * self.spacing

    @torch.no_grad()
    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Numbers [*sample_shape, *batch, 1], from torch's global generator."""
        shape = (*sample_shape, *self.batch_shape)
        uniform = torch.rand(*shape, 1, dtype=self.low.dtype, device=self.low.device)
        flat = GridDensity(self.log_density.expand(*shape, -1), self.low, self.high)
        return flat.icdf(uniform)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """−∫ p log p, by Simpson's rule in each cell."""
        log_density = self._refined()
        return -self._simpson(log_density.exp() * log_density)

    @property
    def mean(self) -> Float[Tensor, "*batch 1"]:
        """∫ a p, exact."""
        return self._simpson(self._refined().exp() * self._refined_grid()).unsqueeze(-1)

    @property
    def variance(self) -> Float[Tensor, "*batch 1"]:
        """∫ (a − mean)² p, exact."""
        square = (self._refined_grid() - self.mean).square()
        return self._simpson(self._refined().exp() * square).unsqueeze(-1)

    @property
    def mode(self) -> Float[Tensor, "*batch 1"]:
        """The grid's most likely point."""
        return self.grid[self.log_density.argmax(-1, keepdim=True)]

    def _refined(self) -> Float[Tensor, "*batch G2"]:
        """Log density at the grid's points and half way between them."""
        left, right = self.log_density[..., :-1], self.log_density[..., 1:]
        middle = torch.logaddexp(left, right) - torch.tensor(2.0).log().to(left)
        inner = torch.stack([left, middle], -1).flatten(-2)
        return torch.cat([inner, self.log_density[..., -1:]], -1)

    def _refined_grid(self) -> Float[Tensor, " G2"]:
        points = 2 * self.grid.shape[-1] - 1
        return torch.linspace(0, 1, points).to(self.low) * (self.high - self.low) + self.low

    def _simpson(self, integrand: Float[Tensor, "*batch G2"]) -> Float[Tensor, "*batch"]:
        """∫ over the interval, exact for cubics in each cell."""
        ends, middles = integrand[..., ::2], integrand[..., 1::2]
        return (2 * _trapezoid(ends) + 4 * middles.sum(-1)) / 6 * self.spacing


def _trapezoid(values: Float[Tensor, "*batch G"]) -> Float[Tensor, "*batch"]:
    return values.sum(-1) - (values[..., 0] + values[..., -1]) / 2


@register_kl(GridDensity, GridDensity)
def _divergence(p: GridDensity, q: GridDensity) -> Tensor:
    """KL(p ‖ q) of densities on the same grid [*batch], by Simpson's rule."""
    log_p = p._refined()
    return p._simpson(log_p.exp() * (log_p - q._refined()))
