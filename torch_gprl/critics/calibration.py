"""How far a critic can be trusted: do its intervals cover the truth, does its advantage follow the true one.

R² of Q says little: most of Q's variance is that of V, and a critic may explain it all while its advantage,
the only thing that a policy gradient uses, is noise.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.gp import Posterior


def interval_coverage(
    predicted: Posterior, truth: Float[Tensor, "*batch N"], level: float = 0.95
) -> Float[Tensor, "*batch"]:
    """Share of the truth within central intervals of probability `level`; `level` itself if calibrated.

    Args:
        predicted: latent mean and variance [*batch, N] for true values, `predictive` for noisy ones.
        truth: [*batch, N].
        level: between 0 and 1.

    Raises:
        ValueError: a level out of its range.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    half = torch.erfinv(torch.as_tensor(level, dtype=truth.dtype)) * 2**0.5  # of a standard normal
    return ((truth - predicted.mean).abs() <= half * predicted.stddev).to(truth.dtype).mean(-1)


def correlation(one: Float[Tensor, "*batch N"], other: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
    """Correlation coefficient over the last dimension; NaN where one of the two does not vary."""
    centred = [x - x.mean(-1, keepdim=True) for x in (one, other)]
    norms = [torch.linalg.vector_norm(x, dim=-1) for x in centred]
    return torch.linalg.vecdot(*centred) / (norms[0] * norms[1])
