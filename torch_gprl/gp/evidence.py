"""Hyper-parameters by maximum marginal likelihood, accepted only where they predict unseen data no worse.

Rasmussen and Williams (2006), section 5.4.1, equations (5.8) and (5.9), with the gradient by autograd.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.gp.door import admit_data
from torch_gprl.gp.exact import ExactGP
from torch_gprl.gp.sparse_online import SparseOnlineGP

HELD_OUT_EVERY = 4  # one point in four judges the fit and takes no part in it


def fit_hyperparameters(
    gp: SparseOnlineGP,
    inputs: Float[Tensor, "*#batch N D"],
    targets: Float[Tensor, "*#batch N"],
    steps: int = 50,
    learning_rate: float = 0.1,
    noise_floor: float = 1e-4,
) -> Bool[Tensor, "*batch"]:
    """Fit kernel parameters and noise of `gp` to data by Adam on the exact log marginal likelihood.

    Every learner keeps its old parameters if the log predictive density of its held-out points would fall.
    What `gp` has learned before stays, seen through the new kernel (`SparseOnlineGP.rebase`). The cost is
    cubic in N: a few hundred points are plenty.

    Args:
        gp: process whose parameters are set; its kernel should have the batch shape of the process.
        inputs: [*batch, N, D].
        targets: [*batch, N].
        steps: of the optimiser.
        learning_rate: of Adam, on the logarithms of the parameters.
        noise_floor: smallest noise variance allowed.

    Returns:
        which learners took the new parameters, [*batch].

    Raises:
        ValueError: NaN or infinite data, wrong shapes, or fewer than 8 points.
    """
    inputs, targets, _ = admit_data(inputs, targets, None, gp.batch_shape, gp.basis)
    if inputs.shape[-2] < 8:
        raise ValueError(f"fitting hyper-parameters needs at least 8 points, got {inputs.shape[-2]}")
    held_out = torch.arange(inputs.shape[-2], device=inputs.device) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    model = ExactGP(gp.kernel)
    model.log_noise_variance = gp.log_noise_variance
    model.fit(inputs[..., ~held_out, :], targets[..., ~held_out])
    judged = inputs[..., held_out, :], targets[..., held_out]
    parameters = list(model.parameters())
    before, density = [p.detach().clone() for p in parameters], _predictive_density(model, *judged)
    optimiser = torch.optim.Adam(parameters, lr=learning_rate)
    for _ in range(steps):
        optimiser.zero_grad()
        (-model.log_marginal_likelihood().sum()).backward()
        optimiser.step()
        with torch.no_grad():
            gp.log_noise_variance.clamp_(min=math.log(noise_floor))
    accept = _predictive_density(model, *judged) >= density
    with torch.no_grad():
        for parameter, old in zip(parameters, before, strict=True):
            keep = accept.reshape(accept.shape + (1,) * (parameter.ndim - accept.ndim))
            parameter.copy_(torch.where(keep, parameter, old))
    gp.rebase()
    return accept


@torch.no_grad()
def _predictive_density(model: ExactGP, inputs: Tensor, targets: Tensor) -> Tensor:
    """Mean log density of targets under the model's predictions, [*batch]."""
    latent = model.posterior(inputs)
    variance = latent.variance + model.noise_variance.unsqueeze(-1)
    return -0.5 * ((targets - latent.mean).square() / variance + (2 * math.pi * variance).log()).mean(-1)
