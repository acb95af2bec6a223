"""Kernels: covariance functions, batched over independent learners, differentiable in all that they take."""

from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.stationary import Matern, SquaredExponential

__all__ = ["Kernel", "Matern", "SquaredExponential"]
