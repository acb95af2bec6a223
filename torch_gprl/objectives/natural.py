"""The natural policy gradient with a trust region: the step of largest improvement at a given KL divergence.

Kakade (2001), "A natural policy gradient"; Schulman et al. (2015), appendix C, for conjugate gradients on
Fisher-vector products. All learners at once: each has its own gradient, Fisher matrix and step size.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

TOLERANCE = 4.0  # trust regions that a step may take in truth: its length comes from a quadratic form
SHORTENINGS = 8  # tenfold, of a step that would take more; then it is not taken


def natural_step(
    parameters: Sequence[nn.Parameter],
    divergence: Callable[[], Float[Tensor, " learners"]],
    max_divergence: float,
    iterations: int = 10,
    damping: float = 1e-3,
) -> Float[Tensor, " learners"]:
    """Move `parameters` against their `.grad` by the natural gradient, as far as `max_divergence`.

    Steps that would diverge several times as far are shortened.

    Args:
        parameters: each [learners, ...], with gradients of a loss that is a sum over learners.
        divergence: mean KL(π_old ‖ π) of each learner [learners] as a function of the parameters; it is zero,
            with zero gradient, at their present values.
        max_divergence: trust region, in nats.
        iterations: of conjugate gradients.
        damping: added to the Fisher matrix, relative to its mean diagonal along the gradient.

    Returns:
        the norm of each learner's gradient [learners].
    """
    gradient = _flatten([p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters])
    fisher = _fisher_products(parameters, divergence)
    curvature = (gradient * fisher(gradient)).sum(-1, keepdim=True)
    relative = damping * curvature / gradient.square().sum(-1, keepdim=True).clamp_min(1e-30)
    direction = conjugate_gradients(lambda v: fisher(v) + relative * v, gradient, iterations)
    _move(parameters, -direction, fisher, divergence, max_divergence)
    return gradient.norm(dim=-1)


def step_along(
    direction: Float[Tensor, "learners P"],
    parameters: Sequence[nn.Parameter],
    divergence: Callable[[], Float[Tensor, " learners"]],
    max_divergence: float,
) -> None:
    """Move `parameters` along a direction as far as `max_divergence`; see `natural_step` for the others.

    Args:
        direction: of ascent, the parameters flattened and in their order; a learner whose direction is zero
            stays where it is.
        parameters: as `natural_step`.
        divergence: as `natural_step`.
        max_divergence: as `natural_step`.
    """
    fisher = _fisher_products(parameters, divergence)
    _move(parameters, direction, fisher, divergence, max_divergence)


def _fisher_products(
    parameters: Sequence[nn.Parameter], divergence: Callable[[], Tensor]
) -> Callable[[Tensor], Tensor]:
    """Products of each learner's Fisher matrix with a vector [learners, P]."""
    slope = torch.autograd.grad(divergence().sum(), parameters, create_graph=True)

    def fisher(vector: Tensor) -> Tensor:
        product = torch.autograd.grad(slope, parameters, _unflatten(vector, parameters), retain_graph=True)
        return _flatten(product)

    return fisher


@torch.no_grad()
def _move(
    parameters: Sequence[nn.Parameter],
    direction: Tensor,
    fisher: Callable[[Tensor], Tensor],
    divergence: Callable[[], Tensor],
    max_divergence: float,
) -> None:
    quadratic = (direction * fisher(direction)).sum(-1, keepdim=True)
    size = (2 * max_divergence / quadratic.clamp_min(1e-30)).sqrt()
    flat = quadratic <= 1e-30 * direction.square().sum(-1, keepdim=True)  # nothing to learn a length from
    step = torch.nan_to_num(torch.where(flat, 0.0, size * direction), nan=0.0, posinf=0.0, neginf=0.0)
    before = [parameter.clone() for parameter in parameters]
    near = torch.zeros_like(step[:, 0], dtype=torch.bool)
    # where the Fisher matrix almost vanishes, its quadratic form promises steps that are far too long
    for _ in range(SHORTENINGS):
        for parameter, old, part in zip(parameters, before, _unflatten(step, parameters), strict=True):
            parameter.copy_(old + part)
        near = divergence() <= TOLERANCE * max_divergence  # NaN is not
        if near.all():
            return
        step = torch.where(near.unsqueeze(-1), step, 0.1 * step)
    for parameter, old in zip(parameters, before, strict=True):
        keep = near.reshape(-1, *[1] * (parameter.ndim - 1))
        parameter.copy_(torch.where(keep, parameter, old))


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], right: Float[Tensor, "learners P"], iterations: int
) -> Float[Tensor, "learners P"]:
    """Solve A x = right for each learner, A symmetric positive definite and known by its products."""
    solution, residual = torch.zeros_like(right), right.clone()
    direction, square = residual.clone(), residual.square().sum(-1, keepdim=True)
    for _ in range(iterations):
        image = product(direction)
        rate = square / (direction * image).sum(-1, keepdim=True).clamp_min(1e-30)
        solution = solution + rate * direction
        residual = residual - rate * image
        previous, square = square, residual.square().sum(-1, keepdim=True)
        direction = residual + square / previous.clamp_min(1e-30) * direction
    return solution


def _flatten(tensors: Sequence[Tensor]) -> Float[Tensor, "learners P"]:
    return torch.cat([tensor.flatten(1) for tensor in tensors], 1)


def _unflatten(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    parts = flat.split([tensor[0].numel() for tensor in like], 1)
    return [part.reshape(tensor.shape) for part, tensor in zip(parts, like, strict=True)]
