"""Graphs of experience: nodes, edges and shortest paths, for the kernels that measure distance along them."""

from torch_gprl.graphs.covering import Cover, farthest_points
from torch_gprl.graphs.edges import EdgeRule, NearestEdges, ThresholdEdges
from torch_gprl.graphs.experience import Experience
from torch_gprl.graphs.transition import TransitionGraph

__all__ = [
    "Cover",
    "EdgeRule",
    "Experience",
    "NearestEdges",
    "ThresholdEdges",
    "TransitionGraph",
    "farthest_points",
]
