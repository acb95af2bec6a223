"""Hyper-parameters by maximum marginal likelihood, accepted only where they predict unseen data no worse.

Rasmussen and Williams (2006), section 5.4.1, equations (5.8) and (5.9), with the gradient by autograd. Priors
of the kernel, if it has any, make it maximum a posteriori.
"""

import math
import warnings
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torch_gprl.gp.door import admit_data
from torch_gprl.gp.exact import ExactGP
from torch_gprl.gp.posterior import Posterior
from torch_gprl.gp.sparse_online import SparseOnlineGP
from torch_gprl.linalg import CholeskyError

HELD_OUT_EVERY = 4  # one point in four judges the fit and takes no part in it


def fit_hyperparameters(
    gp: SparseOnlineGP,
    inputs: Float[Tensor, "*#batch N D"],
    targets: Float[Tensor, "*#batch N"],
    steps: int = 50,
    learning_rate: float = 0.1,
    noise_floor: float = 1e-4,
    evidence: Literal["data", "stream"] = "data",
) -> Bool[Tensor, "*batch"]:
    """Fit kernel parameters (and noise) of `gp` by Adam on a log marginal likelihood.

    `evidence="data"` takes the exact evidence of three quarters of the given points, for kernel and noise;
    the rest judges. The cost is cubic in N: a few hundred points are plenty. `evidence="stream"` takes the
    evidence of all that `gp` has learned so far, for the kernel alone (the noise is absorbed in it); all
    given points judge, and should be new to `gp`.

    Every learner keeps its old parameters if the log predictive density of the judging points would fall.
    What `gp` has learned before stays, seen through the new kernel (`SparseOnlineGP.rebase`).

    Args:
        gp: process whose parameters are set; its kernel should have the batch shape of the process.
        inputs: [*batch, N, D].
        targets: [*batch, N].
        steps: of the optimiser.
        learning_rate: of Adam, on the logarithms of the parameters.
        noise_floor: smallest noise variance allowed.
        evidence: of the given data, or of the stream behind `gp`.

    Returns:
        which learners took the new parameters, [*batch].

    Raises:
        ValueError: NaN or infinite data, wrong shapes, fewer than 8 points, or an unknown kind of evidence.
    """
    inputs, targets, _ = admit_data(inputs, targets, None, gp.batch_shape, gp.basis)
    if inputs.shape[-2] < 8:
        raise ValueError(f"fitting hyper-parameters needs at least 8 points, got {inputs.shape[-2]}")
    if gp.kernel.batch_shape != gp.batch_shape:
        raise ValueError(
            "each learner fits its own parameters, so the kernel's batch_shape "
            f"{tuple(gp.kernel.batch_shape)} must be that of the process, {tuple(gp.batch_shape)}"
        )
    if evidence not in ("data", "stream"):
        raise ValueError(f"evidence must be 'data' or 'stream', got {evidence!r}")
    parameters: list[nn.Parameter] = list(gp.kernel.parameters())
    if evidence == "stream":
        objective, predict, judges = gp.log_marginal_likelihood, gp.posterior, (inputs, targets)
    else:
        held_out = torch.arange(inputs.shape[-2], device=inputs.device) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
        model = ExactGP(gp.kernel)
        model.log_noise_variance = gp.log_noise_variance
        model.fit(inputs[..., ~held_out, :], targets[..., ~held_out])
        objective, predict = model.log_marginal_likelihood, model.posterior
        judges = inputs[..., held_out, :], targets[..., held_out]
        parameters.append(gp.log_noise_variance)
    before = [parameter.detach().clone() for parameter in parameters]
    density = _predictive_density(predict, gp, *judges)
    try:
        _ascend(
            lambda: objective() + gp.kernel.log_prior(), parameters, steps, learning_rate, gp, noise_floor
        )
        accept = _predictive_density(predict, gp, *judges) >= density
    except CholeskyError as error:
        warnings.warn(
            f"the fit ran into parameters without a posterior and was undone: {error}", stacklevel=2
        )
        accept = torch.zeros_like(density, dtype=torch.bool)
    with torch.no_grad():
        for parameter, old in zip(parameters, before, strict=True):
            keep = accept.reshape(accept.shape + (1,) * (parameter.ndim - accept.ndim))
            parameter.copy_(torch.where(keep, parameter, old))
    gp.rebase()
    return accept


def _ascend(
    objective: Callable[[], Tensor],
    parameters: list[nn.Parameter],
    steps: int,
    learning_rate: float,
    gp: SparseOnlineGP,
    noise_floor: float,
) -> None:
    optimiser = torch.optim.Adam(parameters, lr=learning_rate)
    for _ in range(steps):
        optimiser.zero_grad()
        (-objective().sum()).backward()
        optimiser.step()
        with torch.no_grad():
            gp.log_noise_variance.clamp_(min=math.log(noise_floor))
    optimiser.zero_grad()


@torch.no_grad()
def _predictive_density(
    predict: Callable[[Tensor], Posterior], gp: SparseOnlineGP, inputs: Tensor, targets: Tensor
) -> Tensor:
    """Mean log density of targets under noisy predictions, [*batch]."""
    latent = predict(inputs)
    variance = latent.variance + gp.noise_variance.unsqueeze(-1)
    return -0.5 * ((targets - latent.mean).square() / variance + (2 * math.pi * variance).log()).mean(-1)
