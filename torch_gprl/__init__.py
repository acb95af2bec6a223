"""Reinforcement learning for robots with Gaussian-process value functions, in PyTorch."""

__version__ = "0.1.0"
