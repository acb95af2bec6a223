"""Positive parameters: length scales, variances and their like, kept as logarithms that may go anywhere."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

PositiveValue = Tensor | float | Sequence[float]


class Positive:
    """A positive attribute of a module, kept as the unconstrained parameter `log_<name>`.

    Reading gives the exponential, differentiable. Assigning copies into the parameter, broadcasting, so that
    an optimiser that holds it goes on holding it; ValueError if a value is not positive and finite.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, module: nn.Module, owner: type) -> Tensor:
        return getattr(module, f"log_{self.name}").exp()

    def __set__(self, module: nn.Module, value: PositiveValue) -> None:
        with torch.no_grad():
            getattr(module, f"log_{self.name}").copy_(positive(value, self.name).log())


def log_parameter(value: PositiveValue, name: str, shape: Sequence[int]) -> nn.Parameter:
    """The logarithm of a positive value, broadcast to a shape, as a float64 parameter.

    Raises:
        ValueError: the value is not positive and finite, or does not broadcast to the shape.
    """
    log_value = positive(value, name).log()
    if torch.broadcast_shapes(log_value.shape, torch.Size(shape)) != torch.Size(shape):
        raise ValueError(f"{name} must broadcast to {tuple(shape)}, got shape {tuple(log_value.shape)}")
    return nn.Parameter(log_value.expand(torch.Size(shape)).clone())


def positive(value: PositiveValue, name: str) -> Tensor:
    """The value as a detached float64 tensor; ValueError, with its name, if it is not positive and finite."""
    tensor = torch.as_tensor(value, dtype=torch.float64).detach()
    if not ((tensor > 0) & tensor.isfinite()).all():
        raise ValueError(f"{name} must be positive and finite, got {tensor.tolist()}")
    return tensor
