"""A door for GPyTorch's kernels: what is not here may be there.

https://docs.gpytorch.ai/en/stable/kernels.html. GPyTorch itself is not imported.
"""

import torch
from torch import nn

from torch_gprl.kernels.base import Kernel
from torch_gprl.typing import CrossMatrix, Inputs, OtherInputs, PerPoint


class GPyTorchKernel(Kernel):
    """A kernel of GPyTorch as one of ours: `GPyTorchKernel(ScaleKernel(CosineKernel()), input_dim=3)`.

    Its parameters are turned to float64, in place, since GPyTorch makes them float32. They keep GPyTorch's
    names, constraints and priors: `set_prior` and `log_prior` do not see them.

    Args:
        kernel: a `gpytorch.kernels.Kernel`.
        input_dim: number of input columns D.
    """

    def __init__(self, kernel: nn.Module, input_dim: int) -> None:
        super().__init__(input_dim, torch.Size(getattr(kernel, "batch_shape", ())))
        self.kernel = kernel.double()

    def forward(self, x: Inputs, z: OtherInputs) -> CrossMatrix:
        """Covariance of x [*batch, N, D] with z [*batch, M, D]: [*batch, N, M]."""
        return self.kernel(x, z).to_dense()

    def diag(self, x: Inputs) -> PerPoint:
        """Prior variance at x [*batch, N, D]: [*batch, N]."""
        return self.kernel(x, diag=True)
