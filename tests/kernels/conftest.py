"""One of each kernel, over three inputs, for the tests that hold for all of them."""

from collections.abc import Callable, Sequence

import pytest
import torch

from torch_gprl.kernels import (
    Columns,
    Kernel,
    Linear,
    Matern,
    Periodic,
    RationalQuadratic,
    SquaredExponential,
)

DIM = 3
Batch = Sequence[int]


def scales(batch: Batch, *shape: int) -> torch.Tensor:
    """Distinct positive numbers, the same for the same batch."""
    count = torch.Size((*batch, *shape)).numel()
    return torch.linspace(0.6, 1.7, max(count, 2), dtype=torch.float64)[:count].reshape((*batch, *shape))


def matern(smoothness: float) -> Callable[[Batch], Kernel]:
    return lambda batch: Matern(DIM, scales(batch, DIM), scales(batch), batch, smoothness)


def state_action(batch: Batch) -> Kernel:
    state = Matern(2, scales(batch, 2), scales(batch), batch, 2.5)
    return Columns(state, (2, 0), DIM) * Columns(SquaredExponential(1, 0.8), (1,), DIM)


KINDS: dict[str, Callable[[Batch], Kernel]] = {
    "squared exponential": lambda batch: SquaredExponential(DIM, scales(batch, DIM), scales(batch), batch),
    "matern 1/2": matern(0.5),
    "matern 3/2": matern(1.5),
    "matern 5/2": matern(2.5),
    "rational quadratic": lambda batch: RationalQuadratic(
        DIM, scales(batch, DIM), scales(batch), batch, scales(batch) + 0.5
    ),
    "periodic": lambda batch: Periodic(DIM, scales(batch, DIM), scales(batch), batch, period=[6.0, 3.0, 5.0]),
    "linear": lambda batch: Linear(DIM, scales(batch, DIM), scales(batch), batch),
    "sum": lambda batch: Linear(DIM, scales(batch, DIM)[..., :1], 0.5, batch) + SquaredExponential(DIM),
    "scaled product": lambda batch: 2.5 * matern(1.5)(batch) * Periodic(DIM, 0.9),
    "columns": state_action,
}


@pytest.fixture(params=KINDS, scope="session")
def make(request: pytest.FixtureRequest) -> Callable[[Batch], Kernel]:
    """Makes the same kernel, of a batch shape, each time it is called."""
    return KINDS[request.param]
