"""Policies: deterministic controllers f(s, θ) and the exploration round them."""

from torch_gprl.policies.controllers import Controller, LinearController, MLPController, RBFController
from torch_gprl.policies.gaussian import GaussianPolicy, gaussian_policy

__all__ = [
    "Controller",
    "GaussianPolicy",
    "LinearController",
    "MLPController",
    "RBFController",
    "gaussian_policy",
]
