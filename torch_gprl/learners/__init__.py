"""Learners: each a loop that reads top to bottom."""

from torch_gprl.learners.policy_gradient import PolicyGradient, PolicyGradientConfig

__all__ = ["PolicyGradient", "PolicyGradientConfig"]
