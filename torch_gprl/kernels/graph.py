"""What the kernels on a graph share: what the graph says of an input, and what it leaves open.

A graph knows its nodes. Any other input borrows from the nodes near it, with features F(x), |F(x)| ≤ 1:

    k(x, z) = σ² (F(x) F(z)ᵀ + √(ρ(x) ρ(z)) exp(−|x − z|/ℓ)),   ρ(x) = 1 − |F(x)|²

The second term is an ordinary Matérn 1/2 kernel for the part that the graph leaves open. Without nodes, and
far from all of them, nothing else remains. Positive semi-definite by construction, with prior variance σ²
everywhere.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.distance import log_gaussian
from torch_gprl.kernels.parameters import Positive, PositiveValue, log_parameter
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint

Table = tuple[Tensor, ...]
Factors = tuple[Tensor, Tensor]
Found = TypeVar("Found")

REMEMBERED = 8  # inputs whose features are kept: a basis, and what one step compares it with
SMALLEST_REST = 1e-12  # of what the graph leaves open: a root of 0 has no derivative


class Watch:
    """Tells whether tensors have changed since they were last looked at."""

    def __init__(self) -> None:
        self._seen: tuple[int, ...] = ()

    def changed(self, tensors: Iterable[Tensor]) -> bool:
        """Whether any has other numbers, or another place in memory, than at the last call."""
        before, self._seen = self._seen, tuple(n for t in tensors for n in (t._version, t.data_ptr()))
        return self._seen != before


class Remembered(Generic[Found]):
    """What was found for the last few inputs, worth keeping until the sources that tell it change."""

    def __init__(self) -> None:
        self._sources = Watch()
        self._kept: deque[tuple[Tensor, int, Found]] = deque(maxlen=REMEMBERED)

    def find(self, x: Tensor, sources: Iterable[Tensor], make: Callable[[Tensor], Found]) -> Found:
        """What `make` says of x, or said of the same numbers before."""
        if self._sources.changed(sources):
            self._kept.clear()
        for old, version, found in self._kept:
            if version == old._version and (_same_memory(old, x) or torch.equal(old, x)):
                return found
        found = make(x)
        self._kept.append((x, x._version, found))
        return found


class TableKernel(Kernel):
    """A kernel F(x) F(z)ᵀ + … whose features need a table made from graph and parameters alone.

    The table is kept until one of these changes, and so are the features of the last few inputs, which one
    step of a Gaussian process asks for several times. What needs a gradient is made anew by each call.

    Args:
        input_dim: number of input columns D.
        batch_shape: independent kernels, each on a graph of its own.
    """

    def __init__(self, input_dim: int, batch_shape: Sequence[int] = ()) -> None:
        super().__init__(input_dim, batch_shape)
        self._table: Table = ()
        self._table_sources = Watch()
        self._remembered: Remembered[Factors] = Remembered()

    @abstractmethod
    def _build_table(self) -> Table:
        """What depends on graph and parameters alone."""

    @abstractmethod
    def _build_features(self, x: Tensor, table: Table) -> Factors:
        """Two tensors [*batch, N, …] for each row of x [*batch, N, D]."""

    def _sources_of_table(self) -> list[Tensor]:
        """Parameters and buffers on which the table depends: all unless told."""
        return [*self.parameters(), *self.buffers()]

    def features(self, x: Inputs) -> Factors:
        """What the covariance needs of x [*batch, N, D], see `_build_features`."""
        sources = [*self.parameters(), *self.buffers()]
        x = x.to(sources[0].dtype)
        if torch.is_grad_enabled() and (x.requires_grad or any(source.requires_grad for source in sources)):
            return self._features_of_rows(x, self._current_table())
        with torch.no_grad():
            return self._remembered.find(
                x, sources, lambda x: self._features_of_rows(x, self._current_table())
            )

    def _current_table(self) -> Table:
        sources = self._sources_of_table()
        if torch.is_grad_enabled() and any(source.requires_grad for source in sources):
            return self._build_table()
        if self._table_sources.changed(sources):
            with torch.no_grad():
                self._table = self._build_table()
        return self._table

    def _features_of_rows(self, x: Tensor, table: Table) -> Factors:
        """Features of x, whose leading dimensions beyond the kernel's batch are more rows of each learner."""
        extra = x.ndim - 2 - len(self.batch_shape)
        if extra <= 0:
            return self._build_features(x, table)
        rows = x.flatten(0, extra - 1).movedim(0, -3)  # [*batch, rest, N, D]
        left, right = (
            found.unflatten(-2, rows.shape[-3:-1]).movedim(-3, 0).unflatten(0, x.shape[:extra])
            for found in self._build_features(rows.flatten(-3, -2), table)
        )
        return left, right


class GraphKernel(TableKernel):
    """σ² (what the graph explains + what it leaves open).

    Args:
        input_dim: number of input columns D.
        lengthscale: ℓ, the length over which correlation falls to 1/e, in units of the inputs; broadcasts to
            [*batch_shape].
        outputscale: σ², prior variance; broadcasts to [*batch_shape].
        batch_shape: independent kernels, each on a graph of its own.
    """

    lengthscale = Positive()
    outputscale = Positive()

    def __init__(
        self,
        input_dim: int,
        lengthscale: PositiveValue = 1.0,
        outputscale: PositiveValue = 1.0,
        batch_shape: Sequence[int] = (),
    ) -> None:
        super().__init__(input_dim, batch_shape)
        self.log_lengthscale = log_parameter(lengthscale, "lengthscale", batch_shape)
        self.log_outputscale = log_parameter(outputscale, "outputscale", batch_shape)

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        left, right = self.features(x)
        other_left, other_right = (left, right) if z is x else self.features(z)
        rest, other_rest = _left_open(left, right), _left_open(other_left, other_right)
        log_lengthscale = self.log_lengthscale.unsqueeze(-1).expand(*self.batch_shape, self.input_dim)
        leftover = rest.unsqueeze(-1) * other_rest.unsqueeze(-2) * exponential(x, z, log_lengthscale)
        return self.outputscale[..., None, None] * (left @ other_right.mT + leftover)

    def diag(self, x: Inputs) -> PerPoint:
        """The output scale at every row of x [*batch, N, D]: [*batch, N]."""
        batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
        return self.outputscale.unsqueeze(-1).expand(*batch, x.shape[-2])


def exponential(x: Tensor, z: Tensor, log_lengthscale: Tensor) -> Tensor:
    """exp(−r) with r the distance in units of ℓ [*batch, D]: the Matérn 1/2 correlation [*batch, N, M]."""
    square = -2 * log_gaussian(x, z, log_lengthscale)
    return (-square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()).exp()


def _same_memory(one: Tensor, other: Tensor) -> bool:
    """Whether both are views of the same numbers; `one` is held, so nothing else can have its address."""
    return one.data_ptr() == other.data_ptr() and one.shape == other.shape and one.stride() == other.stride()


def _left_open(left: Tensor, right: Tensor) -> Tensor:
    """√ρ = √(1 − |F|²); roundoff may carry |F|² a hair beyond one."""
    return (1 - torch.linalg.vecdot(left, right)).clamp_min(SMALLEST_REST).sqrt()
