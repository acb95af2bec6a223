"""Averages of kernels over Gaussian columns, against Gauss-Hermite quadrature."""

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_gprl.kernels import Columns, GaussianInputs, Kernel, Linear, Matern, SquaredExponential

DIM = 4
GAUSSIAN = (3, 1)  # columns that are random, in no order


def state_action() -> Kernel:
    """Matérn on the known columns, squared exponential on the random ones."""
    return 1.3 * (Columns(Matern(2), (0, 2), DIM) * Columns(SquaredExponential(2, [0.6, 1.1]), (1, 3), DIM))


KINDS = {
    "squared exponential": lambda: SquaredExponential(DIM, [0.5, 0.9, 1.5, 0.7], 2.0),
    "batch": lambda: SquaredExponential(DIM, torch.tensor([[0.5], [0.9]]), [2.0, 1.0], (2,)),
    "state times action": state_action,
    "linear": lambda: Linear(DIM, [0.5, 0.9, 1.5, 0.7], 0.4),
    "sum": lambda: state_action() + Linear(DIM),
}


@pytest.fixture(params=KINDS)
def kernel(request: pytest.FixtureRequest) -> Kernel:
    return KINDS[request.param]()


def uncertain(count: int) -> GaussianInputs:
    mean, variance = (
        torch.randn(count, DIM, dtype=torch.float64),
        0.5 * torch.rand(count, 2, dtype=torch.float64),
    )
    return GaussianInputs(mean, variance, GAUSSIAN)


def nodes(inputs: GaussianInputs) -> tuple[Tensor, Tensor]:
    """Quadrature points [nodes, N, D] with their weights [nodes], over the random columns."""
    location, weight = (torch.from_numpy(a) for a in np.polynomial.hermite_e.hermegauss(40))
    grid = torch.cartesian_prod(location, location)
    weights = torch.cartesian_prod(weight, weight).prod(-1)
    where = inputs.mean.expand(len(grid), *inputs.mean.shape).clone()
    where[..., list(GAUSSIAN)] += grid.unsqueeze(1) * inputs.variance.sqrt()
    return where, weights / weights.sum()


def test_the_average_agrees_with_quadrature(kernel: Kernel):
    x, z = uncertain(5), torch.randn(6, DIM, dtype=torch.float64)
    where, weights = nodes(x)
    batch = (1,) * len(kernel.batch_shape)
    values = kernel(where.reshape(len(weights), *batch, 5, DIM), z)
    quadrature = torch.tensordot(weights, values, 1)
    torch.testing.assert_close(kernel.expected(x, z), quadrature, rtol=1e-7, atol=1e-8)
    swapped = kernel.expected(GaussianInputs.exactly(z), x)
    torch.testing.assert_close(swapped, quadrature.mT, rtol=1e-7, atol=1e-8)


def test_the_double_average_agrees_with_quadrature(kernel: Kernel):
    x, z = uncertain(3), uncertain(2)
    where, weights = nodes(z)
    batch = (1,) * len(kernel.batch_shape)
    one_sided = kernel.expected(x, where.reshape(len(weights), *batch, 2, DIM))
    quadrature = torch.tensordot(weights, one_sided, 1)
    torch.testing.assert_close(kernel.expected(x, z), quadrature, rtol=1e-7, atol=1e-8)


def test_rows_of_one_set_count_as_independent_draws():
    kernel, x = (
        SquaredExponential(1, 0.8),
        GaussianInputs(torch.zeros(1, 1).double(), torch.ones(1, 1).double(), (0,)),
    )
    # x − x' ~ N(0, 2): E exp(−(x − x')²/2ℓ²) = ℓ/√(ℓ² + 2), not 1
    assert kernel.expected(x, x).item() == pytest.approx(0.8 / (0.64 + 2) ** 0.5)


def test_pairs_alone_are_the_diagonal_of_all(kernel: Kernel):
    x, z = uncertain(3), uncertain(3)
    pairs = kernel.expected(
        GaussianInputs(x.mean[:, None, None], x.variance[:, None, None], GAUSSIAN),
        GaussianInputs(z.mean[:, None, None], z.variance[:, None, None], GAUSSIAN),
    )
    expected = kernel.expected(x, z).diagonal(dim1=-2, dim2=-1).movedim(-1, 0)
    torch.testing.assert_close(pairs.reshape(expected.shape), expected)


def test_without_variance_the_average_is_the_kernel(kernel: Kernel):
    x, z = torch.randn(4, DIM, dtype=torch.float64), torch.randn(3, DIM, dtype=torch.float64)
    certain = GaussianInputs(x, torch.zeros(4, 2, dtype=torch.float64), GAUSSIAN)
    torch.testing.assert_close(kernel.expected(certain, z), kernel(x, z))
    assert torch.equal(kernel.expected(GaussianInputs.exactly(x), z), kernel(x, z))


def test_no_points_have_an_empty_average(kernel: Kernel):
    assert kernel.expected(uncertain(2), torch.zeros(0, DIM, dtype=torch.float64)).shape[-2:] == (2, 0)
    assert kernel.expected(uncertain(0), torch.zeros(3, DIM, dtype=torch.float64)).shape[-2:] == (0, 3)


def test_far_from_the_origin_the_average_keeps_its_digits():
    kernel, x, z = SquaredExponential(DIM), uncertain(4), torch.randn(3, DIM, dtype=torch.float64)
    moved = GaussianInputs(x.mean + 1e5, x.variance, GAUSSIAN)
    torch.testing.assert_close(kernel.expected(moved, z + 1e5), kernel.expected(x, z), rtol=1e-9, atol=1e-10)


def test_gradients_flow_to_means_variances_and_other_points():
    kernel = state_action()

    def average(mean: Tensor, variance: Tensor, z: Tensor) -> Tensor:
        x = GaussianInputs(mean, variance, GAUSSIAN)
        return kernel.expected(x, z) + kernel.expected(x, GaussianInputs(z, variance[:1], GAUSSIAN))

    x, z = uncertain(3), torch.randn(1, DIM, dtype=torch.float64)
    arguments = x.mean.requires_grad_(), x.variance.requires_grad_(), z.requires_grad_()
    assert torch.autograd.gradcheck(average, arguments)


def test_the_variance_of_an_average_is_positive_semi_definite(kernel: Kernel):
    x = uncertain(20)
    eigenvalues = torch.linalg.eigvalsh(kernel.expected(x, x))
    assert (eigenvalues[..., 0] >= -1e-12 * eigenvalues[..., -1]).all()


def test_kernels_without_a_closed_form_say_so():
    with pytest.raises(NotImplementedError, match="Matern has no closed form"):
        Matern(DIM).expected(uncertain(2), torch.zeros(1, DIM, dtype=torch.float64))


def test_a_product_that_shares_a_gaussian_column_says_so():
    shared = SquaredExponential(DIM) * Columns(SquaredExponential(1), (3,), DIM)
    with pytest.raises(NotImplementedError, match=r"column 3 belongs to \['SquaredExponential', 'Columns'\]"):
        shared.expected(uncertain(2), torch.zeros(1, DIM, dtype=torch.float64))


@pytest.mark.parametrize("columns", [(0, 0), (0, 4), (-1, 0)])
def test_columns_that_are_not_there_are_refused(columns: tuple[int, int]):
    with pytest.raises(ValueError, match="distinct numbers from 0 to 3"):
        GaussianInputs(torch.zeros(2, DIM), torch.zeros(2, 2), columns)


def test_a_variance_for_other_columns_is_refused():
    with pytest.raises(ValueError, match="variance needs one column for each of"):
        GaussianInputs(torch.zeros(2, DIM), torch.zeros(2, 1), GAUSSIAN)
