"""Closed-form slopes of radial kernels against automatic differentiation."""

import pytest
import torch
from torch import Tensor

from torch_gprl.kernels import Matern, SquaredExponential
from torch_gprl.kernels.slopes import mean_slopes, radial

LENGTHSCALE = torch.tensor([0.7, 1.3, 4.0], dtype=torch.float64)
KERNELS = [
    SquaredExponential(3, LENGTHSCALE, outputscale=1.7),
    Matern(3, LENGTHSCALE, outputscale=1.7, smoothness=2.5),
]


def points() -> tuple[Tensor, Tensor, Tensor]:
    return (
        torch.randn(2, 5, 3, dtype=torch.float64),
        torch.randn(2, 7, 3, dtype=torch.float64),
        torch.randn(2, 7, dtype=torch.float64),
    )


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: type(kernel).__name__)
def test_the_slopes_of_a_mean_are_its_derivatives(kernel):
    x, z, weights = points()
    x.requires_grad_()
    mean = (kernel(x, z) @ weights.unsqueeze(-1)).squeeze(-1)
    (expected,) = torch.autograd.grad(mean.sum(), x, create_graph=True)
    second = [torch.autograd.grad(expected[..., d].sum(), x, retain_graph=True)[0][..., d] for d in (1, 2)]
    between = radial(kernel, x.detach(), z)
    torch.testing.assert_close(between.value, kernel(x.detach(), z))
    gradient, curvature = mean_slopes(
        between, weights, x.detach()[..., 1:], z[..., 1:], kernel.lengthscale.detach()[1:]
    )
    torch.testing.assert_close(gradient, expected[..., 1:].detach())
    torch.testing.assert_close(curvature, torch.stack(second, -1))


def test_a_kernel_without_second_derivatives_is_refused():
    x, z, _ = points()
    with pytest.raises(ValueError, match=r"smoothness=2\.5"):
        radial(Matern(3, 1.0, smoothness=1.5), x, z)
