"""Learners: each a loop that reads top to bottom."""

from torch_gprl.learners.config import PolicyGradientConfig
from torch_gprl.learners.policy_gradient import PolicyGradient

__all__ = ["PolicyGradient", "PolicyGradientConfig"]
