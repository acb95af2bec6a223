"""Kernels: covariance functions, batched over independent learners, differentiable in all that they take."""

from torch_gprl.kernels.base import Kernel, Product, Scaled, Sum
from torch_gprl.kernels.columns import Columns
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.kernels.gpytorch import GPyTorchKernel
from torch_gprl.kernels.graph_geodesic import GeodesicKernel
from torch_gprl.kernels.graph_nodes import GraphMatern, ShortestPathKernel
from torch_gprl.kernels.graph_successor import SuccessorKernel
from torch_gprl.kernels.graph_values import SuccessorWithRest
from torch_gprl.kernels.linear import Linear
from torch_gprl.kernels.parameters import Positive
from torch_gprl.kernels.stationary import Matern, Periodic, RationalQuadratic, SquaredExponential

__all__ = [
    "Columns",
    "GPyTorchKernel",
    "GaussianInputs",
    "GeodesicKernel",
    "GraphMatern",
    "Kernel",
    "Linear",
    "Matern",
    "Periodic",
    "Positive",
    "Product",
    "RationalQuadratic",
    "Scaled",
    "ShortestPathKernel",
    "SquaredExponential",
    "SuccessorKernel",
    "SuccessorWithRest",
    "Sum",
]
