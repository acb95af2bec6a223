"""GPyTorch's kernels through our door."""

import gpytorch
import torch

from torch_gprl.gp import ExactGP
from torch_gprl.kernels import GPyTorchKernel, SquaredExponential


def points(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, 2, dtype=torch.float64)


def rbf() -> GPyTorchKernel:
    theirs = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=2)).double()
    theirs.outputscale = 2.0
    theirs.base_kernel.lengthscale = torch.tensor([0.5, 1.5], dtype=torch.float64)
    return GPyTorchKernel(theirs, input_dim=2)


def test_a_gpytorch_kernel_is_a_kernel():
    kernel, x, z = rbf(), points(3, 5), points(4)
    ours = SquaredExponential(2, [0.5, 1.5], 2.0)
    torch.testing.assert_close(kernel(x, z), ours(x, z))
    torch.testing.assert_close(kernel.diag(x), ours.diag(x))
    torch.testing.assert_close((kernel + ours)(x, z), 2 * ours(x, z))


def test_a_batch_of_gpytorch_kernels_keeps_its_batch_shape():
    kernel = GPyTorchKernel(gpytorch.kernels.RBFKernel(batch_shape=torch.Size([3])), 2)
    assert kernel.batch_shape == (3,)
    assert kernel(points(3, 5), points(3, 4)).shape == (3, 5, 4)


def test_a_gp_over_a_gpytorch_kernel_learns_in_double_precision_and_has_gradients():
    kernel = GPyTorchKernel(gpytorch.kernels.RBFKernel(), 2)
    gp = ExactGP(kernel, 0.1).fit(points(6), torch.randn(6, dtype=torch.float64))
    gp.log_marginal_likelihood().backward()
    for parameter in kernel.parameters():
        assert parameter.dtype == torch.float64
        assert parameter.grad is not None
        assert parameter.grad.abs().sum() > 0
