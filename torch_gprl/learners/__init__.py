"""Learners: each a loop that reads top to bottom."""

from torch_gprl.learners.actor_critic import ActorCritic
from torch_gprl.learners.actor_critic_config import ActorCriticConfig
from torch_gprl.learners.config import PolicyGradientConfig
from torch_gprl.learners.dynamic_programming import DynamicProgramming
from torch_gprl.learners.dynamic_programming_config import DynamicProgrammingConfig
from torch_gprl.learners.policy_gradient import PolicyGradient
from torch_gprl.learners.q_learning import QLearning
from torch_gprl.learners.q_learning_config import QLearningConfig
from torch_gprl.learners.ray_workers import RayCollection
from torch_gprl.learners.workers import WorkerCollection

__all__ = [
    "ActorCritic",
    "ActorCriticConfig",
    "DynamicProgramming",
    "DynamicProgrammingConfig",
    "PolicyGradient",
    "PolicyGradientConfig",
    "QLearning",
    "QLearningConfig",
    "RayCollection",
    "WorkerCollection",
]
