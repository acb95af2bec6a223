"""Policies: deterministic controllers f(s, θ) and the exploration round them."""

from torch_gprl.policies.averaged import AveragedPolicy
from torch_gprl.policies.behaviour import Behaviour, BehaviourPolicy, Scheme
from torch_gprl.policies.confidence_noise import ConfidenceNoise, ConfidenceScale, Greedy, action_box
from torch_gprl.policies.controllers import (
    Controller,
    LinearController,
    MLPController,
    RBFController,
    ScaledController,
)
from torch_gprl.policies.gaussian import GaussianPolicy, NormalPolicy, gaussian_policy
from torch_gprl.policies.gibbs import GibbsConfig, GibbsPolicy
from torch_gprl.policies.optimistic import ThompsonSampling, UpperConfidence
from torch_gprl.policies.planned import PlannedBehaviour, PlannedPolicy, PlannedScheme
from torch_gprl.policies.streams import NoiseStream

__all__ = [
    "AveragedPolicy",
    "Behaviour",
    "BehaviourPolicy",
    "ConfidenceNoise",
    "ConfidenceScale",
    "Controller",
    "GaussianPolicy",
    "GibbsConfig",
    "GibbsPolicy",
    "Greedy",
    "LinearController",
    "MLPController",
    "NoiseStream",
    "NormalPolicy",
    "PlannedBehaviour",
    "PlannedPolicy",
    "PlannedScheme",
    "RBFController",
    "ScaledController",
    "Scheme",
    "ThompsonSampling",
    "UpperConfidence",
    "action_box",
    "gaussian_policy",
]
