"""Graphs of experience: nodes, edges and shortest paths, for the kernels that measure distance along them."""

from torch_gprl.graphs.edges import EdgeRule, NearestEdges, ThresholdEdges
from torch_gprl.graphs.experience import Experience
from torch_gprl.graphs.transition import TransitionGraph

__all__ = ["EdgeRule", "Experience", "NearestEdges", "ThresholdEdges", "TransitionGraph"]
