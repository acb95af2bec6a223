"""Which basis vectors may go, and what is left of the posterior when they do.

Scores after Csató and Opper (2002, Neural Computation 14) and the thesis' equation (.13); the arithmetic of a
deletion in whitened coordinates, where the basis values are u = L w and the posterior is w ~ N(A⁻¹b, A⁻¹).

| paper | here | meaning |
|---|---|---|
| L | `gram_factor` | Cholesky factor of the Gram matrix of the basis |
| A, b | `precision`, `information` | posterior precision of w, and precision times mean |
| Q_ii | `gram_inverse_diagonal` | diagonal of K⁻¹ |
| Q_ii + C_ii | `posterior_precision_diagonal` | diagonal of L⁻ᵀA⁻¹L⁻¹ |
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torch_gprl.gp.whitened import solve_triangular, squared_columns
from torch_gprl.linalg import cholesky


class BasisStatistics(NamedTuple):
    """What a pruning score may look at, each [*batch, B]; entries outside `mask` mean nothing."""

    alpha: Float[Tensor, "*batch B"]
    gram_inverse_diagonal: Float[Tensor, "*batch B"]
    posterior_precision_diagonal: Callable[[], Float[Tensor, "*batch B"]]  # few scores ask, and it costs
    stamps: Int[Tensor, "*batch B"]
    mask: Bool[Tensor, "*batch B"]


class Whitened(NamedTuple):
    """The state of a sparse GP that a deletion rewrites; see the module's table."""

    gram_factor: Float[Tensor, "*batch B B"]
    precision: Float[Tensor, "*batch B B"]
    information: Float[Tensor, "*batch B"]


def basis_statistics(
    state: Whitened, stamps: Int[Tensor, "*batch B"], mask: Bool[Tensor, "*batch B"]
) -> BasisStatistics:
    """What a score sees of a basis, [*batch, B] each."""
    eye = torch.eye(stamps.shape[-1], dtype=state.precision.dtype, device=stamps.device)
    inverse_factor = solve_triangular(state.gram_factor.contiguous(), eye.expand_as(state.gram_factor))
    precision_factor = cholesky(state.precision)
    weights = torch.cholesky_solve(state.information.unsqueeze(-1), precision_factor)
    alpha = (inverse_factor.mT @ weights).squeeze(-1)  # L⁻ᵀA⁻¹b

    def posterior_precision_diagonal() -> Tensor:
        return squared_columns(solve_triangular(precision_factor, inverse_factor))

    return BasisStatistics(alpha, squared_columns(inverse_factor), posterior_precision_diagonal, stamps, mask)


@runtime_checkable
class PruningScore(Protocol):
    """Maps statistics of the basis to a score per basis vector; the smallest scores are deleted."""

    def __call__(self, statistics: BasisStatistics) -> Float[Tensor, "*batch B"]:
        """Score each basis vector."""
        ...


class InformationScore:
    """How much the posterior changes when a basis vector goes.

    `"mean"`: (α_i / Q_ii)², the squared change of the mean at the vector under marginal deletion (the robust
    partner of `projection="moment"`). `"kl"`: α_i² / (Q_ii + C_ii), the Kullback-Leibler score of Csató and
    Opper, which belongs to their conditioning deletion (`projection="dtc"`).
    """

    def __init__(self, kind: Literal["mean", "kl"] = "mean") -> None:
        if kind not in ("mean", "kl"):
            raise ValueError(f"an information score is 'mean' or 'kl', got {kind!r}")
        self.kind = kind

    def __call__(self, statistics: BasisStatistics) -> Float[Tensor, "*batch B"]:
        """Score each basis vector [*batch, B]."""
        if self.kind == "mean":
            return (statistics.alpha / statistics.gram_inverse_diagonal).square()
        return statistics.alpha.square() / statistics.posterior_precision_diagonal()

    def __repr__(self) -> str:
        return f"InformationScore({self.kind!r})"


class AgeAwareScore:
    """Information and age together, the thesis' equations (.13) and (.14): old and useless vectors go first.

    The score is (1 − λ) ε / mean(ε) + λ g(t) with the information score ε and the stamp t, the policy update
    that added the vector. g is bounded and finite, unlike the printed forms, which overflow or are infinite:

        exponential   g = exp((t − t_max) / timescale), in (0, 1]
        logit         g = ½ − logit(u) / (2 logit(0.01)), u = 0.01 + 0.98 (t − t_min) / (t_max − t_min)

    λ = 0 is the information score, λ = 1 first in, first out; equal stamps make age irrelevant.

    Args:
        age_weight: λ, from 0 to 1.
        form: of g.
        timescale: policy updates after which the exponential form has fallen to 1/e; beyond 700 of them ages
            count as equal.
        base: score of the information.

    Raises:
        ValueError: a weight outside [0, 1], another form, or a timescale that is not positive.
    """

    def __init__(
        self,
        age_weight: float,
        form: Literal["exponential", "logit"] = "exponential",
        timescale: float = 10.0,
        base: PruningScore | None = None,
    ) -> None:
        if not 0 <= age_weight <= 1:
            raise ValueError(f"age_weight must lie between 0 and 1, got {age_weight}")
        if form not in ("exponential", "logit"):
            raise ValueError(f"form must be 'exponential' or 'logit', got {form!r}")
        if not timescale > 0:
            raise ValueError(f"timescale must be positive (policy updates), got {timescale}")
        self.age_weight, self.form, self.timescale = age_weight, form, timescale
        self.base = InformationScore() if base is None else base

    def __call__(self, statistics: BasisStatistics) -> Float[Tensor, "*batch B"]:
        """Score each basis vector [*batch, B]."""
        information = torch.where(statistics.mask, self.base(statistics), 0.0)
        mean = information.sum(-1, keepdim=True) / statistics.mask.sum(-1, keepdim=True).clamp_min(1)
        tiny = torch.finfo(mean.dtype).tiny  # a process that has learned nothing yet has no information
        relative = information / mean.clamp_min(tiny)
        return (1 - self.age_weight) * relative + self.age_weight * self.recency(statistics)

    def recency(self, statistics: BasisStatistics) -> Float[Tensor, "*batch B"]:
        """g(t) of each basis vector [*batch, B]: 1 for the newest."""
        stamps, mask = statistics.stamps, statistics.mask
        newest = stamps.masked_fill(~mask, torch.iinfo(stamps.dtype).min).amax(-1, keepdim=True)
        age = (newest - stamps).where(mask, 0).to(statistics.alpha.dtype)
        if self.form == "exponential":
            return torch.exp(-age / self.timescale)
        fresh = 1 - age / age.amax(-1, keepdim=True).clamp_min(1)  # (t − t_min)/(t_max − t_min)
        edge = torch.full_like(fresh, LOGIT_EDGE)
        return 0.5 - torch.logit(edge + (1 - 2 * edge) * fresh) / (2 * torch.logit(edge))

    def __repr__(self) -> str:
        return f"AgeAwareScore({self.age_weight}, {self.form!r}, {self.timescale}, {self.base!r})"


LOGIT_EDGE = 0.01  # how near to 0 and 1 the logit form comes


def keep_first(
    state: Whitened, order: Int[Tensor, "*batch B"], kept: int, projection: Literal["moment", "dtc"]
) -> tuple[Whitened, Float[Tensor, "*batch"]]:
    """Reorder the basis by `order` and delete every vector from position `kept` on.

    With the kept values first, u = P L w = L' w' for an orthogonal w' = T w (one QR), and the deleted values
    are the last entries of w'. `"moment"` marginalises them: the posterior of the kept values is unchanged.
    `"dtc"` conditions them at their prior mean given the kept ones, Csató's toolbox form, overconfident.

    Returns:
        the state [*batch, kept, ...] and the change of the log evidence's constant [*batch]: with `"moment"`
        such that the evidence stays what it was, with `"dtc"` none.
    """
    gram_factor, precision, information = _triangular(state, order, kept)
    left, left_information = precision[..., :kept, :kept], information[..., :kept]
    if projection == "dtc":
        return Whitened(gram_factor, left, left_information), torch.zeros_like(information[..., 0])
    # Schur complement: A_kk − A_kd A_dd⁻¹ A_dk, b_k − A_kd A_dd⁻¹ b_d
    gone_factor = cholesky(precision[..., kept:, kept:])
    right = torch.cat([precision[..., kept:, :kept], information[..., kept:, None]], -1)
    half = solve_triangular(gone_factor, right)
    half_cross, half_information = half[..., :-1], half[..., -1:]
    left = left - half_cross.mT @ half_cross
    left = (left + left.mT).mul_(0.5)
    left_information = left_information - (half_cross.mT @ half_information).squeeze(-1)
    log_determinant = 2 * gone_factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence = 0.5 * (half_information.square().sum((-2, -1)) - log_determinant)
    return Whitened(gram_factor, left, left_information), evidence


PANEL = 48  # columns that are made triangular at once


def _triangular(state: Whitened, order: Tensor, kept: int) -> Whitened:
    """T, A and b in the coordinates w' = T w in which the first `kept` rows of P L are triangular.

    P L = L' T by Householder QR of its transpose, a panel of columns at a time: a vector that moves up by d
    places leaves d entries to be rotated away, so a panel touches few rows more than it has columns.
    """
    rows, lower = order[..., :kept], state.gram_factor
    upper = lower.gather(-2, rows.unsqueeze(-1).expand(*rows.shape, lower.shape[-1])).mT
    # all that is rotated from the left, in one matrix
    joint = torch.cat([upper, state.information.unsqueeze(-1), state.precision], -1)
    precision = joint[..., kept + 1 :]
    reach = rows.cummax(-1).values.reshape(-1, kept).amax(0)  # last entry in the panels up to each column
    for start in range(0, kept, PANEL):
        stop = min(start + PANEL, kept)
        touched = slice(start, int(reach[stop - 1]) + 1)
        rotation, triangle = torch.linalg.qr(joint[..., touched, start:stop], mode="complete")
        joint[..., touched, start:stop] = triangle
        joint[..., touched, stop:] = rotation.mT @ joint[..., touched, stop:]
        precision[..., touched] = precision[..., touched] @ rotation
    sign = torch.ones_like(state.information)
    sign[..., :kept] = joint.diagonal(dim1=-2, dim2=-1)[..., :kept].sign()
    joint.mul_(sign.unsqueeze(-1))
    precision.mul_(sign.unsqueeze(-2))
    return Whitened(joint[..., :kept, :kept].mT, precision, joint[..., kept])
