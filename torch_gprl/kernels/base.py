"""What a kernel is: a covariance function with positive parameters, batched over independent learners.

Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, chapter 4.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Kernel(nn.Module, ABC):
    """A covariance function k(x, z), differentiable in its inputs and its parameters.

    `batch_shape` is the shape of independent hyper-parameters, one set per learner. It broadcasts against the
    leading dimensions of the inputs: a kernel of batch_shape () serves batched inputs too.
    """

    def __init__(self, input_dim: int, batch_shape: Sequence[int] = ()) -> None:
        """Keep the shapes.

        Args:
            input_dim: number of input columns that the kernel takes.
            batch_shape: independent hyper-parameters, one set per learner.
        """
        super().__init__()
        self.input_dim = input_dim
        self.batch_shape = torch.Size(batch_shape)

    @abstractmethod
    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of every row of x [*batch, N, D] with every row of z [*batch, M, D]: [*batch, N, M]."""

    @abstractmethod
    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance k(x, x) of every row of x [*batch, N, D]: [*batch, N]."""


class Positive:
    """A positive parameter `name` of a module, kept as the unconstrained `log_name`.

    Reading gives exp(log_name), differentiable; assigning copies into it, broadcasting, and leaves the
    parameter object, and hence an optimiser that holds it, in place.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        """Learn the name under which the owner knows the parameter."""
        self.name = name

    def __get__(self, module: nn.Module, owner: type | None = None) -> Tensor:
        """The positive value."""
        return getattr(module, f"log_{self.name}").exp()

    def __set__(self, module: nn.Module, value: Tensor | float) -> None:
        """Copy a positive value in; raises ValueError on one that is not."""
        log_value = getattr(module, f"log_{self.name}")
        with torch.no_grad():
            log_value.copy_(positive(value, self.name).log())


def log_parameter(value: Tensor | float, name: str, shape: Sequence[int]) -> nn.Parameter:
    """The logarithm of a positive value, broadcast to a shape, as a float64 parameter."""
    return nn.Parameter(positive(value, name).log().expand(torch.Size(shape)).clone())


def positive(value: Tensor | float, name: str) -> Tensor:
    """The value as a detached float64 tensor; raises ValueError if any of it is not positive and finite."""
    tensor = torch.as_tensor(value, dtype=torch.float64).detach()
    if not ((tensor > 0) & tensor.isfinite()).all():
        raise ValueError(
            f"{name} must be positive and finite, got {tensor.tolist()}; give numbers above zero"
        )
    return tensor
