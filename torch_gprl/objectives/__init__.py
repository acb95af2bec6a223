"""Objectives: losses whose gradient is the policy gradient, and the natural step along it."""

from torch_gprl.objectives.all_action import AllActionLoss
from torch_gprl.objectives.natural import natural_step
from torch_gprl.objectives.policy_gradient import PolicyGradientLoss

__all__ = ["AllActionLoss", "PolicyGradientLoss", "natural_step"]
