"""A density on a box by its values at scattered candidates: importance sampling from a mixture.

Half of the candidates cover the box evenly, half gather round a point, where the density is thought to have
its mass; both are one scrambled Sobol sequence, shifted for each state (Cranley and Patterson, 1976; Owen and
Zhou, 2000, for the mixture and its balance weights).
"""

# torch declares as properties what its own distributions set as attributes:
# pyright: reportIncompatibleMethodOverride=false, reportAssignmentType=false

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints, register_kl
from torch.quasirandom import SobolEngine

from torch_gprl.policies.gibbs_energy import Window


class Candidates(NamedTuple):
    """Actions to weigh at each state, and the log density from which they come."""

    action: Float[Tensor, "*batch P A"]
    log_proposal: Float[Tensor, "*batch P"]


class Proposal:
    """Draws candidates: half uniform on the box, half normal round the window's middle, cut off at the box.

    Args:
        low, high: the box, [A] each.
        count: candidates for each state, even and at least 4.

    Raises:
        ValueError: another count.
    """

    def __init__(self, low: Float[Tensor, " A"], high: Float[Tensor, " A"], count: int) -> None:
        if count < 4 or count % 2:
            raise ValueError(f"candidates come in two halves: an even number of at least 4, got {count}")
        self.low, self.high = low, high
        self.points = SobolEngine(len(low), scramble=True, seed=0).draw(count // 2).to(low)

    def draw(self, window: Window, shift: Float[Tensor, "*batch A"]) -> Candidates:
        """Candidates of each state [*batch, P, A], by uniform numbers in [0, 1) of its own."""
        low, high = self.low, self.high
        uniform = (self.points + shift.unsqueeze(-2)).remainder(1)
        # a middle outside the box would leave no mass inside
        middle = window.loc.clamp(low, high).unsqueeze(-2)
        near = Near(middle, window.width.unsqueeze(-2), low, high)
        action = torch.cat([low + uniform * (high - low), near.icdf(uniform)], -2)
        everywhere = -(high - low).log().sum()
        log_proposal = torch.logaddexp(near.log_prob(action), everywhere) - torch.tensor(2.0).log().to(low)
        return Candidates(action, log_proposal)


class Near(NamedTuple):
    """Independent normal variables, each cut off at its bounds."""

    middle: Tensor
    width: Tensor
    low: Tensor
    high: Tensor

    def icdf(self, uniform: Tensor) -> Tensor:
        """Inverse of the distribution function, elementwise."""
        below, above = self._ends()
        standard = torch.special.ndtri(below + uniform * (above - below))
        return (self.middle + self.width * standard).clamp(self.low, self.high)

    def log_prob(self, action: Tensor) -> Tensor:
        """Log density, summed over the last dimension."""
        below, above = self._ends()
        square = ((action - self.middle) / self.width).square()
        return (-0.5 * square - (above - below).log() - self.width.log() - LOG_SQRT_2PI).sum(-1)

    def _ends(self) -> tuple[Tensor, Tensor]:
        ends = ((bound - self.middle) / self.width for bound in (self.low, self.high))
        below, above = (torch.special.ndtr(end) for end in ends)
        return below, above


LOG_SQRT_2PI = 0.9189385332046727


class CandidateDensity(Distribution):
    """A density on a box, normalised and sampled by weighted candidates.

    Log-probabilities are those of the continuous density; normaliser, moments, entropy and samples are
    importance-weighted sums over the candidates, with an error that falls faster than one over their root.

    Args:
        candidates: actions and the log density they come from.
        log_density: logarithm of the density at the candidates, up to a constant, [*batch, P].
        log_density_at: the same for any action [*batch, A]: [*batch].
    """

    arg_constraints = {}  # noqa: RUF012  (torch's own convention)
    support = constraints.real_vector
    has_rsample = False

    def __init__(
        self,
        candidates: Candidates,
        log_density: Float[Tensor, "*batch P"],
        log_density_at: Callable[[Tensor], Tensor],
    ) -> None:
        self.candidates, self.log_density, self.log_density_at = candidates, log_density, log_density_at
        ratio = log_density - candidates.log_proposal
        self.log_normaliser = ratio.logsumexp(-1) - torch.tensor(float(ratio.shape[-1])).log().to(ratio)
        self.weight = ratio.softmax(-1)
        self._entropy = self.log_normaliser - (self.weight * log_density).sum(-1)
        super().__init__(log_density.shape[:-1], candidates.action.shape[-1:], validate_args=False)

    def log_prob(self, value: Float[Tensor, "*batch A"]) -> Float[Tensor, "*batch"]:
        """Log density at actions within the box."""
        return self.log_density_at(value) - self.log_normaliser

    @torch.no_grad()
    def pick(self, uniform: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch A"]:
        """A candidate by its weight, from uniform numbers in [0, 1)."""
        cumulative = self.weight.cumsum(-1)
        wanted = uniform.to(cumulative) * cumulative[..., -1:]
        index = torch.searchsorted(cumulative, wanted.contiguous()).clamp_max(cumulative.shape[-1] - 1)
        return self.candidates.action.take_along_dim(index.unsqueeze(-1), -2).squeeze(-2)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Candidates by their weights [*sample_shape, *batch, A], from torch's global generator."""
        index = torch.distributions.Categorical(probs=self.weight).sample(torch.Size(sample_shape))
        actions = self.candidates.action.expand(*sample_shape, *self.candidates.action.shape)
        return actions.take_along_dim(index[..., None, None], -2).squeeze(-2)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """−E log p."""
        return self._entropy

    @property
    def mean(self) -> Float[Tensor, "*batch A"]:
        """E a."""
        return (self.weight.unsqueeze(-1) * self.candidates.action).sum(-2)

    @property
    def variance(self) -> Float[Tensor, "*batch A"]:
        """E (a − E a)², of each dimension."""
        square = (self.candidates.action - self.mean.unsqueeze(-2)).square()
        return (self.weight.unsqueeze(-1) * square).sum(-2)


@register_kl(CandidateDensity, CandidateDensity)
def _divergence(p: CandidateDensity, q: CandidateDensity) -> Tensor:
    """KL(p ‖ q) of densities weighed at the same candidates [*batch]."""
    difference = (p.weight * (p.log_density - q.log_density)).sum(-1)
    return difference - p.log_normaliser + q.log_normaliser
