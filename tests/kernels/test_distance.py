"""Distances: two ways to compute them, one answer, also far from the origin."""

import pytest
import torch
from torch import Tensor

from torch_gprl.kernels import SquaredExponential
from torch_gprl.kernels.distance import DIRECT_SIZE, log_gaussian


def longhand(x: Tensor, z: Tensor, log_lengthscale: Tensor, log_outputscale: Tensor) -> Tensor:
    difference = (x.unsqueeze(-2) - z.unsqueeze(-3)) / log_lengthscale.exp()
    return log_outputscale - 0.5 * difference.square().sum(-1)


LARGE = 200  # 200 · 200 · 2 products: beyond the direct way


@pytest.mark.parametrize("count", [10, LARGE])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_both_ways_agree_with_the_formula_to_the_rounding_of_the_points(count: int, offset: float):
    assert (count * count * 2 > DIRECT_SIZE) == (count == LARGE)
    x, z = (offset + torch.randn(count, 2, dtype=torch.float64) for _ in range(2))
    scale, height = torch.tensor([-0.3, 0.5], dtype=torch.float64), torch.tensor(0.7, dtype=torch.float64)
    rounding = (200 + 20 * offset) * torch.finfo(torch.float64).eps
    torch.testing.assert_close(
        log_gaussian(x, z, scale, height), longhand(x, z, scale, height), rtol=rounding, atol=rounding
    )


@pytest.mark.parametrize("count", [10, LARGE])
def test_one_tensor_with_itself_has_an_exact_diagonal(count: int):
    x = 50.0 + torch.randn(3, count, 2, dtype=torch.float64)
    scale, height = torch.zeros(2, dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    diagonal = log_gaussian(x, x, scale, height).diagonal(dim1=-2, dim2=-1)
    assert torch.equal(diagonal, height.unsqueeze(-1).expand(3, count))
    assert not log_gaussian(x, x, scale).diagonal(dim1=-2, dim2=-1).any()


def test_the_gradient_of_the_exact_diagonal_is_that_of_the_output_scale():
    x = torch.randn(4, 2, dtype=torch.float64, requires_grad=True)
    height = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    diagonal = log_gaussian(x, x, torch.zeros(2, dtype=torch.float64), height).diagonal().sum()
    by_point, by_height = torch.autograd.grad(diagonal, [x, height])
    assert not by_point.any()
    assert by_height == 4.0


@pytest.mark.parametrize(
    ("learners", "basis", "inputs"),
    [((), (), ()), ((3,), (3,), (3,)), ((), (2, 3), (2, 3)), ((3,), (3,), ())],
)
def test_a_prepared_kernel_is_the_kernel_with_both_derivatives(
    learners: tuple[int, ...], basis: tuple[int, ...], inputs: tuple[int, ...]
):
    kernel = SquaredExponential(2, 0.7, 1.3, learners).requires_grad_(False)
    z = torch.randn(*basis, 5, 2, dtype=torch.float64)
    x = torch.randn(*inputs, 3, 2, dtype=torch.float64, requires_grad=True)
    prepared = kernel.against(z)
    torch.testing.assert_close(prepared(x), kernel(x, z).mT)
    assert torch.autograd.gradcheck(prepared, x)
    assert torch.autograd.gradgradcheck(prepared, x)
