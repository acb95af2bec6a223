"""Critics: the bridge between tensordicts of experience and the Gaussian process."""

from torch_gprl.critics.action_value import GPActionValue
from torch_gprl.critics.calibration import correlation, interval_coverage
from torch_gprl.critics.estimators import ESTIMATORS, USE_ALL_ACTIONS, EstimatorName, Evaluation
from torch_gprl.critics.gaussian_actions import action_moments, clipped_moments
from torch_gprl.critics.kernels_by_name import (
    KernelName,
    action_value_kernel,
    clear_graphs,
    follow_basis,
    graph_edges,
    graphs,
    store_transitions,
    suit_graphs,
)
from torch_gprl.critics.maximise import ActionMaximiser, Maximum
from torch_gprl.critics.plan import Planning
from torch_gprl.critics.planned_value import PlannedValue
from torch_gprl.critics.returns import k_step_returns
from torch_gprl.critics.transition_model import TransitionModel, Transitions
from torch_gprl.critics.value_estimator import Critic, GPStateValue, GPValueEstimator

__all__ = [
    "ESTIMATORS",
    "USE_ALL_ACTIONS",
    "ActionMaximiser",
    "Critic",
    "EstimatorName",
    "Evaluation",
    "GPActionValue",
    "GPStateValue",
    "GPValueEstimator",
    "KernelName",
    "Maximum",
    "PlannedValue",
    "Planning",
    "TransitionModel",
    "Transitions",
    "action_moments",
    "action_value_kernel",
    "clear_graphs",
    "clipped_moments",
    "correlation",
    "follow_basis",
    "graph_edges",
    "graphs",
    "interval_coverage",
    "k_step_returns",
    "store_transitions",
    "suit_graphs",
]
