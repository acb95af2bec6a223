"""The door of a GP: data come in here, are cast to the model's dtype, and are turned away if they are bad."""

import math

import numpy as np
import torch
from torch import Tensor

from torch_gprl.kernels.gaussian_inputs import GaussianInputs


def admit_inputs(inputs: Tensor, batch_shape: torch.Size, like: Tensor) -> Tensor:
    """Inputs [*batch, N, D] in the dtype of `like` [*batch, B, D], expanded to `batch_shape`.

    Raises:
        ValueError: the last two dimensions are not (points, input dimensions of the model), or the leading
            ones do not broadcast to `batch_shape`.
    """
    shape, dims = inputs.shape, like.shape[-1]
    if len(shape) > 1 and shape == (*batch_shape, shape[-2], dims):  # the usual case, told cheaply
        return inputs if inputs.dtype == like.dtype else inputs.to(like.dtype)
    if inputs.ndim < 2 or inputs.shape[-1] != dims or not _broadcasts(inputs.shape[:-2], batch_shape):
        raise ValueError(
            f"inputs must be [*{tuple(batch_shape)}, points, {dims}], got {tuple(inputs.shape)}; "
            "a single point is inputs[..., None, :]"
        )
    return inputs.to(like.dtype).expand(*batch_shape, *shape[-2:])


def admit_points(
    points: Tensor | GaussianInputs, batch_shape: torch.Size, like: Tensor
) -> Tensor | GaussianInputs:
    """Points where f, or its average over Gaussian columns, is asked for; see `admit_inputs`."""
    if not isinstance(points, GaussianInputs):
        return admit_inputs(points, batch_shape, like)
    mean = admit_inputs(points.mean, batch_shape, like)
    return GaussianInputs(mean, points.variance.to(like.dtype).expand(*mean.shape[:-1], -1), points.columns)


def admit_data(
    inputs: Tensor, targets: Tensor, mask: Tensor | None, batch_shape: torch.Size, like: Tensor
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Inputs, targets and mask for an update; entries that the mask leaves out may hold anything.

    Raises:
        ValueError: shapes that do not fit each other, NaN or infinity in data that count.
    """
    inputs = admit_inputs(inputs, batch_shape, like)
    targets = _one_per_input("targets", targets, inputs).to(like.dtype)
    if mask is not None:
        mask = _one_per_input("mask", mask, inputs).to(torch.bool)
        inputs = torch.where(mask.unsqueeze(-1), inputs, 0.0)
        targets = torch.where(mask, targets, 0.0)
    if not _seem_finite(inputs, targets):  # details only on failure
        for name, tensor in (("inputs", inputs), ("targets", targets)):
            refuse_non_finite(name, tensor)
    return inputs, targets, mask


def admit_successors(
    next_inputs: Tensor | GaussianInputs,
    discount: float | Tensor,
    mask: Tensor | None,
    points: torch.Size,
    like: Tensor,
) -> tuple[GaussianInputs, Tensor]:
    """Successors of points [*batch, N], and their discounts; where that is 0 anything may stand.

    Raises:
        ValueError: shapes that do not fit the points, NaN or infinity in data that count.
    """
    if not isinstance(next_inputs, GaussianInputs):
        next_inputs = GaussianInputs.exactly(next_inputs)
    rate = torch.as_tensor(discount, dtype=like.dtype, device=like.device)
    if not _broadcasts(rate.shape, points):
        raise ValueError(
            f"discount must be a number or {tuple(points)}, one per input, got {tuple(rate.shape)}; "
            "0 stands where no successor counts"
        )
    rate = rate.expand(points)
    counts = rate != 0 if mask is None else mask & (rate != 0)
    mean, rate, _ = admit_data(next_inputs.mean, rate, counts, points[:-1], like)
    variance = next_inputs.variance.to(mean.dtype).expand(*mean.shape[:-1], -1)
    variance = torch.where(counts.unsqueeze(-1), variance, 0.0)
    refuse_non_finite("variance of next_inputs", variance)
    return GaussianInputs(mean, variance, next_inputs.columns), rate


def _seem_finite(inputs: Tensor, targets: Tensor) -> bool:
    """False if an entry is not finite, or numbers are huge; one synchronisation with the device."""
    if not inputs.is_cpu:
        return math.isfinite(float(inputs.sum() + targets.sum()))
    x, y = inputs.detach().numpy(), targets.detach().numpy()  # NumPy's calls cost less
    return math.isfinite(np.vdot(x, x) + np.vdot(y, y))


def _one_per_input(name: str, tensor: Tensor, inputs: Tensor) -> Tensor:
    expected = inputs.shape[:-1]
    if tensor.shape == expected:
        return tensor
    if not _broadcasts(tensor.shape, expected):
        raise ValueError(f"{name} must be {tuple(expected)}, one per input, got {tuple(tensor.shape)}")
    return tensor.expand(expected)


def _broadcasts(shape: torch.Size, target: torch.Size) -> bool:
    if shape == target:
        return True
    padded = (1,) * (len(target) - len(shape)) + tuple(shape)
    return len(padded) == len(target) and all(a in (1, b) for a, b in zip(padded, target, strict=True))


def refuse_non_finite(name: str, tensor: Tensor) -> None:
    """Raise a ValueError that names the first NaN or infinity in `tensor`, if there is any."""
    bad = ~torch.isfinite(tensor)
    if bool(bad.any()):
        where = bad.nonzero()[0].tolist()
        raise ValueError(
            f"{name} must be finite: {int(bad.sum())} of {bad.numel()} values are not, the first is "
            f"{tensor[tuple(where)].item()} at index {where}; the model is unchanged. "
            "Usually the reward or the simulation diverged: drop those points with mask="
        )
