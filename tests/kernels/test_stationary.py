"""Stationary kernels against their formulas and against scikit-learn and GPyTorch."""

import gpytorch
import pytest
import torch
from sklearn.gaussian_process import kernels as sk
from torch import Tensor

from torch_gprl.kernels import Kernel, Matern, Periodic, RationalQuadratic, SquaredExponential

LENGTHSCALE = [0.5, 1.5, 3.0]


def points(count: int, dim: int = 3) -> Tensor:
    return torch.randn(count, dim, dtype=torch.float64)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (SquaredExponential(3, LENGTHSCALE, 2.0), 2.0 * sk.RBF(LENGTHSCALE)),
        (Matern(3, LENGTHSCALE, 2.0, smoothness=0.5), 2.0 * sk.Matern(LENGTHSCALE, nu=0.5)),
        (Matern(3, LENGTHSCALE, 2.0, smoothness=1.5), 2.0 * sk.Matern(LENGTHSCALE, nu=1.5)),
        (Matern(3, LENGTHSCALE, 2.0, smoothness=2.5), 2.0 * sk.Matern(LENGTHSCALE, nu=2.5)),
        (RationalQuadratic(3, 0.7, 2.0, mixture=1.3), 2.0 * sk.RationalQuadratic(0.7, alpha=1.3)),
    ],
    ids=lambda kernel: str(kernel) if isinstance(kernel, sk.Kernel) else type(kernel).__name__,
)
def test_agreement_with_scikit_learn(ours: Kernel, theirs: sk.Kernel):
    x, z = points(7), points(5)
    torch.testing.assert_close(ours(x, z).detach(), torch.from_numpy(theirs(x.numpy(), z.numpy())))


def test_the_periodic_kernel_agrees_with_scikit_learn():
    x, z = points(7, 1), points(5, 1)
    theirs = sk.ExpSineSquared(length_scale=0.8, periodicity=2.5)
    ours = Periodic(1, 0.8, period=2.5)
    torch.testing.assert_close(ours(x, z).detach(), torch.from_numpy(theirs(x.numpy(), z.numpy())))


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (SquaredExponential(3, LENGTHSCALE), gpytorch.kernels.RBFKernel(ard_num_dims=3)),
        (Matern(3, LENGTHSCALE, smoothness=0.5), gpytorch.kernels.MaternKernel(nu=0.5, ard_num_dims=3)),
        (Matern(3, LENGTHSCALE, smoothness=1.5), gpytorch.kernels.MaternKernel(nu=1.5, ard_num_dims=3)),
        (Matern(3, LENGTHSCALE, smoothness=2.5), gpytorch.kernels.MaternKernel(nu=2.5, ard_num_dims=3)),
        (RationalQuadratic(3, LENGTHSCALE), gpytorch.kernels.RQKernel(ard_num_dims=3)),
    ],
    ids=lambda kernel: type(kernel).__name__,
)
def test_agreement_with_gpytorch(ours: Kernel, theirs: gpytorch.kernels.Kernel):
    theirs = theirs.double()
    theirs.lengthscale = torch.tensor(LENGTHSCALE, dtype=torch.float64)
    if isinstance(ours, RationalQuadratic):
        ours.mixture = theirs.alpha.detach().squeeze()
    x, z = points(7), points(5)
    torch.testing.assert_close(ours(x, z), theirs(x, z).to_dense(), rtol=1e-9, atol=1e-9)


def test_an_angle_and_the_same_angle_a_turn_later_are_one_point():
    kernel, x = Periodic(2, 0.7), points(4, 2)
    turned = x + 2 * torch.pi * torch.tensor([1.0, -3.0], dtype=torch.float64)
    torch.testing.assert_close(kernel(x, turned), kernel(x, x))


def test_the_period_is_no_parameter_but_is_saved():
    kernel = Periodic(1, period=3.0)
    assert "period" not in dict(kernel.named_parameters())
    other = Periodic(1)
    other.load_state_dict(kernel.state_dict())
    assert other.period == 3.0


def test_rational_quadratic_tends_to_the_squared_exponential():
    x, z = points(6), points(4)
    limit = RationalQuadratic(3, LENGTHSCALE, 2.0, mixture=1e7)(x, z)
    torch.testing.assert_close(limit, SquaredExponential(3, LENGTHSCALE, 2.0)(x, z), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("smoothness", [0.5, 1.5, 2.5])
def test_matern_far_away_is_zero_and_not_nan(smoothness: float):
    kernel = Matern(1, smoothness=smoothness)
    x = torch.tensor([[0.0]], dtype=torch.float64, requires_grad=True)
    value = kernel(x, torch.tensor([[1e8]], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert value == 0
    assert gradient == 0


def test_the_kink_of_matern_one_half_has_slope_zero_and_unit_slopes_beside_it():
    kernel, z = Matern(1, smoothness=0.5), torch.zeros(1, 1, dtype=torch.float64)
    x = torch.tensor([[-1e-6], [0.0], [1e-6]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(kernel(x, z).sum(), x)
    torch.testing.assert_close(
        slope.squeeze(), torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64), rtol=0, atol=1e-5
    )


def test_the_squared_exponential_curves_at_its_top_by_the_inverse_square_length_scale():
    kernel, z = SquaredExponential(1, 0.5, 3.0), torch.full((1, 1), 0.3, dtype=torch.float64)
    curvature = torch.autograd.functional.hessian(lambda x: kernel(x, z).sum(), z.clone())
    assert curvature.item() == pytest.approx(-3.0 / 0.25, rel=1e-12)


def test_another_smoothness_is_refused():
    with pytest.raises(ValueError, match=r"smoothness must be 0.5, 1.5 or 2.5, got 2.0"):
        Matern(1, smoothness=2.0)
