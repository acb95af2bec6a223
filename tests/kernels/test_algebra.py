"""Sums, products, multiples, columns, priors: the algebra of kernels."""

import math

import pytest
import torch
from sklearn.gaussian_process import kernels as sk
from torch import Tensor
from torch.distributions import Gamma, LogNormal

from torch_gprl.kernels import Columns, Linear, Matern, Periodic, SquaredExponential


def points(count: int, dim: int = 2) -> Tensor:
    return torch.randn(count, dim, dtype=torch.float64)


def test_operators_add_multiply_and_scale_covariances():
    a, b, x, z = SquaredExponential(2, 0.7), Matern(2, 1.3), points(5), points(4)
    torch.testing.assert_close((a + b)(x, z), a(x, z) + b(x, z))
    torch.testing.assert_close((a * b)(x, z), a(x, z) * b(x, z))
    torch.testing.assert_close((2.0 * a)(x, z), 2.0 * a(x, z))
    torch.testing.assert_close((a * 2.0)(x, z), 2.0 * a(x, z))
    torch.testing.assert_close((a + b * a).diag(x), a.diag(x) + b.diag(x) * a.diag(x))


def test_the_factor_of_a_multiple_is_a_parameter():
    kernel = 2.0 * SquaredExponential(2, batch_shape=(3,))
    kernel.outputscale = torch.tensor([1.0, 2.0, 3.0])
    assert dict(kernel.named_parameters())["log_outputscale"].shape == (3,)
    torch.testing.assert_close(
        kernel.diag(points(1)).squeeze(), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    )


def test_the_linear_kernel_agrees_with_scikit_learn():
    x, z = points(5), points(4)
    theirs = torch.from_numpy(sk.DotProduct(sigma_0=1.7)(x.numpy(), z.numpy()))
    torch.testing.assert_close(Linear(2, bias_variance=1.7**2)(x, z).detach(), theirs)


def test_a_kernel_on_columns_sees_these_columns_in_this_order():
    x, z = points(5, 4), points(3, 4)
    inner = SquaredExponential(2, [0.5, 2.0])
    for columns in ((3, 1), (1, 2)):
        kernel = Columns(inner, columns, 4)
        torch.testing.assert_close(kernel(x, z), inner(x[:, list(columns)], z[:, list(columns)]))
        torch.testing.assert_close(kernel.diag(x), inner.diag(x[:, list(columns)]))


def test_a_product_over_columns_is_one_squared_exponential():
    x, z = points(5, 3), points(4, 3)
    state, action = SquaredExponential(2, [0.5, 2.0], 3.0), SquaredExponential(1, 0.8)
    product = Columns(state, (0, 1), 3) * Columns(action, (2,), 3)
    torch.testing.assert_close(product(x, z), SquaredExponential(3, [0.5, 2.0, 0.8], 3.0)(x, z))


def test_active_columns_are_those_on_which_a_kernel_depends():
    angle, rest = Columns(Periodic(1), (2,), 4), Columns(Columns(Matern(1), (1,), 2), (0, 3), 4)
    assert angle.active_columns == {2}
    assert rest.active_columns == {3}
    assert (2.0 * (angle + rest)).active_columns == {2, 3}


@pytest.mark.parametrize(
    ("columns", "message"), [((0,), "2 distinct"), ((1, 1), "2 distinct"), ((0, 4), "0 and 3")]
)
def test_columns_that_do_not_fit_are_refused(columns: tuple[int, ...], message: str):
    with pytest.raises(ValueError, match=message):
        Columns(SquaredExponential(2), columns, 4)


def test_kernels_of_different_input_dimensions_do_not_add():
    with pytest.raises(ValueError, match=r"Sum needs kernels of one input_dim, got \[1, 2\]"):
        SquaredExponential(1) + SquaredExponential(2)


def test_the_prior_of_a_composite_adds_the_densities_of_its_parts():
    a, b = SquaredExponential(2, 0.5), Matern(2, 1.0, 3.0)
    a.set_prior("lengthscale", LogNormal(0.0, 1.0))
    b.set_prior("outputscale", Gamma(2.0, 3.0))
    kernel = 2.0 * a + b
    half = -math.log(0.5) - 0.5 * math.log(2 * math.pi) - 0.5 * math.log(0.5) ** 2  # log-normal at 0.5
    gamma = 2 * math.log(3.0) + math.log(3.0) - 9.0  # log of 3² x e^{−3x} at 3
    assert kernel.log_prior().item() == pytest.approx(2 * half + gamma)


def test_the_prior_of_a_batch_is_one_number_per_learner():
    kernel = SquaredExponential(2, torch.tensor([[0.5], [2.0]]), batch_shape=(2,))
    assert torch.equal(kernel.log_prior(), torch.zeros(2, dtype=torch.float64))
    kernel.set_prior("lengthscale", LogNormal(0.0, 1.0))
    kernel.set_prior("outputscale", LogNormal(0.0, 1.0))
    single = SquaredExponential(2, 2.0)
    single.priors = kernel.priors
    assert kernel.log_prior().shape == (2,)
    torch.testing.assert_close(kernel.log_prior()[1], single.log_prior())


def test_the_prior_is_differentiable():
    kernel = Matern(1, 2.0)
    kernel.set_prior("lengthscale", LogNormal(0.0, 1.0))
    kernel.log_prior().backward()
    # d/d log ℓ of −log ℓ − ½ log² ℓ
    assert kernel.log_lengthscale.grad is not None
    assert kernel.log_lengthscale.grad.item() == pytest.approx(-1 - math.log(2.0))


def test_a_prior_on_what_is_no_parameter_is_refused():
    with pytest.raises(
        ValueError, match=r"no positive parameter 'period'; choose one of \['lengthscale', 'outputscale'\]"
    ):
        Periodic(1).set_prior("period", LogNormal(0.0, 1.0))
