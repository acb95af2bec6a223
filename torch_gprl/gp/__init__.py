"""Gaussian processes: the sparse online one, and the plain twins that it is tested against."""

from torch_gprl.gp.evidence import fit_hyperparameters
from torch_gprl.gp.exact import ExactGP
from torch_gprl.gp.parallel import ParallelSparseGP, broadcast_state
from torch_gprl.gp.posterior import Posterior
from torch_gprl.gp.pruning import AgeAwareScore, BasisStatistics, InformationScore, PruningScore
from torch_gprl.gp.recursion import RecursiveGP
from torch_gprl.gp.regression import SparseRegression
from torch_gprl.gp.sample_paths import Paths, PathSampler
from torch_gprl.gp.sparse_online import SparseOnlineGP

__all__ = [
    "AgeAwareScore",
    "BasisStatistics",
    "ExactGP",
    "InformationScore",
    "ParallelSparseGP",
    "PathSampler",
    "Paths",
    "Posterior",
    "PruningScore",
    "RecursiveGP",
    "SparseOnlineGP",
    "SparseRegression",
    "broadcast_state",
    "fit_hyperparameters",
]
