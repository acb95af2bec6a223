"""Objectives: losses whose gradient is the policy gradient, and the natural step along it."""

from torch_gprl.objectives.all_action import AllActionLoss
from torch_gprl.objectives.episodic import compatible_weights, episode_scores, split_episodes
from torch_gprl.objectives.natural import natural_step, step_along
from torch_gprl.objectives.policy_gradient import PolicyGradientLoss

__all__ = [
    "AllActionLoss",
    "PolicyGradientLoss",
    "compatible_weights",
    "episode_scores",
    "natural_step",
    "split_episodes",
    "step_along",
]
