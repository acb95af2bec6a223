"""What a kernel is, and the algebra of kernels: sums, products and multiples are kernels again.

Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, section 4.2.4. A kernel is a
covariance function with positive parameters, batched over independent learners.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add, mul

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class Kernel(nn.Module, ABC):
    """A covariance function k(x, z), differentiable in its inputs and its parameters.

    `k1 + k2`, `k1 * k2` and `2.0 * k` are kernels too. Parameters are float64 until `.to()` says otherwise.

    Args:
        input_dim: number of input columns D.
        batch_shape: independent hyper-parameters, one set per learner. It broadcasts against the leading
            dimensions of the inputs: a kernel of batch_shape () serves batched inputs too.
    """

    def __init__(self, input_dim: int, batch_shape: Sequence[int] = ()) -> None:
        super().__init__()
        self.input_dim = input_dim
        self.batch_shape = torch.Size(batch_shape)
        self.priors: dict[str, Distribution] = {}

    @abstractmethod
    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of every row of x [*batch, N, D] with every row of z [*batch, M, D]: [*batch, N, M]."""

    @abstractmethod
    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance k(x, x) of every row of x [*batch, N, D]: [*batch, N]."""

    def against(self, z: OtherInputs) -> Callable[[Inputs], CrossMatrix]:
        """The function x ↦ k(z, x) [*batch, M, N], for one z and many x.

        Kernels may compute beforehand what depends on z alone. The parameters are those of now, and neither
        they nor z need get a gradient; x does.
        """
        return lambda x: self(x, z).mT

    @property
    def active_columns(self) -> frozenset[int]:
        """The input columns on which the kernel depends."""
        return frozenset(range(self.input_dim))

    def expected(self, x: GaussianInputs, z: OtherInputs | GaussianInputs) -> CrossMatrix:
        """E[k(x, z)] over the Gaussian columns of x, and of z where it has some: [*batch, N, M].

        This is the covariance of averages: E_a[k((s, a), z)] is that of E_a[f(s, a)] with f(z). Rows of x and
        of z count as independent draws, even where they are the same rows, as the variance of an average
        wants it. For pairs (x_i, z_i) alone, put the points in the batch: means [N, 1, D]. Differentiable in
        means and variances.

        Raises:
            NotImplementedError: no closed form; squared exponential and linear kernels have one, and so have
                sums and products of them with kernels on other columns.
        """
        other = z if isinstance(z, GaussianInputs) else GaussianInputs.exactly(z)
        if x.columns or other.columns:
            return self._expected(x, other)
        return self(x.mean, other.mean)

    def expansion(self, z: OtherInputs, weights: Tensor) -> Callable[[Inputs], Tensor]:
        """The functions x ↦ Σ_m k(x, z_m) w_m [*batch, N, T] of weights [*batch, M, T]: posterior means.

        Differentiable in x alone, with what does not depend on x computed beforehand.
        """
        against, weights = self.against(z), weights.detach()
        return lambda x: against(x).mT @ weights

    def expected_pairs(self, x: GaussianInputs, z: GaussianInputs) -> PerPoint:
        """E[k(x_i, z_i)] of each row of x with the same row of z, independent draws: [*batch, N].

        Raises:
            NotImplementedError: no closed form, see `expected`.
        """
        return self.expected(x.points_first(), z.points_first()).movedim(0, -1).flatten(-3)

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        raise NotImplementedError(
            f"{type(self).__name__} has no closed form average over Gaussian columns; use "
            "SquaredExponential or Linear on these columns, times any kernel on the others by Columns"
        )

    def set_prior(self, name: str, prior: Distribution) -> None:
        """Put a prior on a positive parameter of this kernel; `log_prior` adds its log density.

        Args:
            name: the parameter, such as "lengthscale".
            prior: distribution of its value (not of its logarithm), broadcast over its shape. `.to()` does
                not move it: give it numbers, or tensors on the right device.

        Raises:
            ValueError: this kernel has no such parameter.
        """
        attributes = {key: value for owner in type(self).__mro__ for key, value in vars(owner).items()}
        owned = sorted(key for key, value in attributes.items() if isinstance(value, Positive))
        if name not in owned:
            raise ValueError(
                f"{type(self).__name__} has no positive parameter {name!r}; choose one of {owned}"
            )
        self.priors[name] = prior

    def log_prior(self) -> Tensor:
        """Log density of all parameters with a prior, of this kernel and of its parts: [*batch_shape]."""
        total = next(self.parameters()).new_zeros(self.batch_shape)
        for kernel in self.modules():
            if isinstance(kernel, Kernel):
                for name, prior in kernel.priors.items():
                    log_density = prior.log_prob(getattr(kernel, name))
                    total = total + log_density.reshape(*kernel.batch_shape, -1).sum(-1)
        return total

    def __add__(self, other: "Kernel") -> "Kernel":
        return Sum(self, other)

    def __mul__(self, other: "Kernel | float") -> "Kernel":
        return Product(self, other) if isinstance(other, Kernel) else Scaled(self, other)

    __rmul__ = __mul__


class Scaled(Kernel):
    """A multiple of a kernel, by the positive parameter `outputscale`.

    Args:
        kernel: the kernel to scale.
        outputscale: the factor, in squared units of the targets; broadcasts to the kernel's batch_shape.
    """

    outputscale = Positive()

    def __init__(self, kernel: Kernel, outputscale: PositiveValue = 1.0) -> None:
        super().__init__(kernel.input_dim, kernel.batch_shape)
        self.kernel = kernel
        self.log_outputscale = log_parameter(outputscale, "outputscale", self.batch_shape)

    @property
    def active_columns(self) -> frozenset[int]:
        """The input columns on which the kernel depends."""
        return self.kernel.active_columns

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        return self.outputscale[..., None, None] * self.kernel(x, z)

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return self.outputscale[..., None] * self.kernel.diag(x)

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        return self.outputscale[..., None, None] * self.kernel.expected(x, z)


class _Composite(Kernel):
    """Several kernels on the same inputs; their batch shapes broadcast."""

    def __init__(self, *kernels: Kernel) -> None:
        dims = {kernel.input_dim for kernel in kernels}
        if len(dims) != 1:
            raise ValueError(
                f"{type(self).__name__} needs kernels of one input_dim, got "
                f"{[kernel.input_dim for kernel in kernels]}; Columns(kernel, columns, input_dim) puts one "
                "on some columns of wider inputs"
            )
        super().__init__(dims.pop(), torch.broadcast_shapes(*(kernel.batch_shape for kernel in kernels)))
        self.kernels = nn.ModuleList(kernels)

    @property
    def active_columns(self) -> frozenset[int]:
        """The input columns on which any part depends."""
        return frozenset().union(*(kernel.active_columns for kernel in self.parts))

    @property
    def parts(self) -> list[Kernel]:
        """The kernels that it is made of."""
        return [kernel for kernel in self.kernels if isinstance(kernel, Kernel)]


class Sum(_Composite):
    """k₁ + k₂ + …: the covariance of a sum of independent functions."""

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        return reduce(add, (kernel(x, z) for kernel in self.parts))

    def against(self, z: OtherInputs) -> Callable[[Inputs], CrossMatrix]:
        """The function x ↦ k(z, x), with what each part computes beforehand; see `Kernel.against`."""
        parts = [kernel.against(z) for kernel in self.parts]
        return lambda x: reduce(add, (part(x) for part in parts))

    def expansion(self, z: OtherInputs, weights: Tensor) -> Callable[[Inputs], Tensor]:
        """The sum of what each part makes of the same weights; see `Kernel.expansion`."""
        parts = [kernel.expansion(z, weights) for kernel in self.parts]
        return lambda x: reduce(add, (part(x) for part in parts))

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return reduce(add, (kernel.diag(x) for kernel in self.parts))

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        return reduce(add, (kernel.expected(x, z) for kernel in self.parts))


class Product(_Composite):
    """k₁ · k₂ · …: the covariance of a product of independent functions."""

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        return reduce(mul, (kernel(x, z) for kernel in self.parts))

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return reduce(mul, (kernel.diag(x) for kernel in self.parts))

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        # the average of a product is the product of averages only over independent, hence separate, columns
        for column in {*x.columns, *z.columns}:
            users = [type(kernel).__name__ for kernel in self.parts if column in kernel.active_columns]
            if len(users) > 1:
                raise NotImplementedError(
                    f"a product has a closed form average only where a Gaussian column belongs to one "
                    f"factor, but column {column} belongs to {users}; put the factors on columns of their own"
                )
        return reduce(mul, (kernel.expected(x, z) for kernel in self.parts))
