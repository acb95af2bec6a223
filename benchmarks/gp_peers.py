"""What the sparse online process is compared with, behind one small interface: learn a block, then predict.

All peers are given the stream's hyper-parameters and float64 data, and keep at most `budget` points.

| name | what it does with a block |
|---|---|
| SparseOnlineGP | ours |
| GPyTorch fantasies | `get_fantasy_model` on an exact process; starts again from the newest ¾ when full |
| scikit-learn refits | `GaussianProcessRegressor.fit` on the newest `budget` points, optimiser off |
| textbook recursion | `RecursiveGP`: Csató and Opper (2002), point by point, in plain PyTorch |
| recursion in place | the same recursion in NumPy, buffers written in place |
"""

import math
import warnings
from collections.abc import Callable
from typing import Protocol

import gpytorch
import numpy as np
import torch
from scipy.linalg.blas import dger
from scipy.spatial.distance import cdist
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from torch import Tensor

from benchmarks.streams import Stream
from torch_gprl.gp import RecursiveGP, SparseOnlineGP

OURS = "SparseOnlineGP"
NOVELTY_THRESHOLD = 0.3  # in noise variances, for all that have one


class Peer(Protocol):
    """A process that learns from a stream."""

    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        ...

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D], without noise."""
        ...


class Sparse:
    """`SparseOnlineGP`, with its defaults; L learners at once if the stream has inputs [L, N, D]."""

    def __init__(self, stream: Stream, budget: int) -> None:
        learners = tuple(stream.inputs.shape[:-2])
        self.gp = SparseOnlineGP(
            stream.kernel, budget, stream.noise_variance, NOVELTY_THRESHOLD, batch_shape=learners
        ).requires_grad_(False)

    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        self.gp.update(inputs, targets)

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D]."""
        return self.gp(inputs)


class Recursion:
    """`RecursiveGP`, our own slow twin, with the same threshold and pruning score."""

    def __init__(self, stream: Stream, budget: int) -> None:
        self.gp = RecursiveGP(stream.kernel, budget, stream.noise_variance, NOVELTY_THRESHOLD)

    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        self.gp.update(inputs, targets)

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D]."""
        return self.gp.posterior(inputs)


class Fantasies:
    """GPyTorch's exact process, conditioned on block after block by low-rank updates of its caches."""

    def __init__(self, stream: Stream, budget: int) -> None:
        self.budget = budget
        self.lengthscale, self.noise_variance = stream.lengthscale, stream.noise_variance
        self.model: gpytorch.models.ExactGP | None = None

    @torch.no_grad()
    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        if self.model is None:
            self._start(inputs[-self.budget :], targets[-self.budget :])
            return
        known, values = self._data()
        if len(values) + len(targets) > self.budget:
            kept = max(0, min(self.budget * 3 // 4, self.budget - len(targets)))
            known, values = known[len(known) - kept :], values[len(values) - kept :]
            known, values = torch.cat([known, inputs]), torch.cat([values, targets])
            self._start(known[-self.budget :], values[-self.budget :])
        else:
            self.model = self.model.get_fantasy_model(inputs, targets)

    @torch.no_grad()
    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D]."""
        assert self.model is not None
        latent = self.model(inputs)
        return latent.mean, latent.variance

    def _data(self) -> tuple[Tensor, Tensor]:
        return self.model.train_inputs[0], self.model.train_targets

    def _start(self, inputs: Tensor, targets: Tensor) -> None:
        likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
        likelihood.noise = self.noise_variance
        kernel = gpytorch.kernels.RBFKernel().double()
        kernel.lengthscale = self.lengthscale
        self.model = _Exact(inputs, targets, likelihood, kernel).eval()
        self.model(inputs[:1] + 1.0)  # fills the caches that a fantasy starts from


class _Exact(gpytorch.models.ExactGP):
    def __init__(
        self,
        inputs: Tensor,
        targets: Tensor,
        likelihood: gpytorch.likelihoods.GaussianLikelihood,
        kernel: gpytorch.kernels.Kernel,
    ) -> None:
        super().__init__(inputs, targets, likelihood)
        self.mean, self.kernel = gpytorch.means.ZeroMean(), kernel

    def forward(self, inputs: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean(inputs), self.kernel(inputs))


class Refits:
    """scikit-learn, fitted anew to the newest points after every block."""

    def __init__(self, stream: Stream, budget: int) -> None:
        self.budget = budget
        self.model = GaussianProcessRegressor(
            RBF(stream.lengthscale), alpha=stream.noise_variance, optimizer=None
        )
        self.inputs, self.targets = np.empty((0, stream.inputs.shape[-1])), np.empty(0)

    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        self.inputs = np.concatenate([self.inputs, inputs.numpy()])[-self.budget :]
        self.targets = np.concatenate([self.targets, targets.numpy()])[-self.budget :]
        self.model.fit(self.inputs, self.targets)

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D]."""
        mean, stddev = self.model.predict(inputs.numpy(), return_std=True)
        return torch.from_numpy(mean), torch.from_numpy(stddev).square()


class InPlaceRecursion:
    """Csató and Opper's recursion as fast as NumPy lets it be: fixed buffers, rank-one updates in place.

    The same algorithm as `RecursiveGP`, moment projection and "mean" score included. Buffers are in Fortran
    order, as BLAS wants them; C and K⁻¹ are symmetric.
    """

    def __init__(self, stream: Stream, budget: int) -> None:
        self.budget, self.size = budget, 0
        self.lengthscale, self.noise_variance = stream.lengthscale, stream.noise_variance
        rows = budget + 1
        self.basis = np.zeros((rows, stream.inputs.shape[-1]))
        self.alpha = np.zeros(rows)
        self.C = np.zeros((rows, rows), order="F")
        self.gram_inverse = np.zeros((rows, rows), order="F")

    def update(self, inputs: Tensor, targets: Tensor) -> None:
        """Learn from a block [N, D], [N]."""
        for point, target in zip(inputs.numpy(), targets.tolist(), strict=True):
            self._learn(point, target)
            if self.size > self.budget:
                self._delete(int(np.abs(self.alpha / self.gram_inverse.diagonal()).argmin()))

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of f at [M, D]."""
        n, points = self.size, inputs.numpy()
        k = np.exp(-0.5 * cdist(points, self.basis[:n], "sqeuclidean") / self.lengthscale**2)
        variance = 1.0 + np.einsum("mi,ij,mj->m", k, self.C[:n, :n], k, optimize=True)
        return torch.from_numpy(k @ self.alpha[:n]), torch.from_numpy(variance)

    def _learn(self, point: np.ndarray, target: float) -> None:
        n = self.size
        difference = (self.basis[:n] - point) / self.lengthscale
        k = np.exp(-0.5 * np.einsum("ij,ij->i", difference, difference))
        e, Ck = self.gram_inverse[:n, :n] @ k, self.C[:n, :n] @ k
        novelty = 1.0 - k @ e
        residual_variance = self.noise_variance + 1.0 + k @ Ck
        s = np.zeros(len(self.alpha))
        s[:n] = Ck
        if novelty > max(NOVELTY_THRESHOLD * self.noise_variance, 1e-10):
            column = np.zeros(len(self.alpha))
            column[:n], column[n] = e, -1.0
            _add_outer(self.gram_inverse, 1.0 / novelty, column, column)
            self.basis[n] = point
            self.size, s[n] = n + 1, 1.0
        else:
            s[:n] += e
        self.alpha += s * ((target - k @ self.alpha[:n]) / residual_variance)
        _add_outer(self.C, -1.0 / residual_variance, s, s)

    def _delete(self, i: int) -> None:
        """Marginalise basis vector i; the last one takes its row."""
        Q, C, last = self.gram_inverse, self.C, self.size - 1
        t = Q[:, i] / Q[i, i]
        _add_outer(Q, -Q[i, i], t, t.copy())
        column, corner = C[:, i].copy(), C[i, i]
        _add_outer(C, corner, t, t.copy())
        _add_outer(C, -1.0, t, column)
        _add_outer(C, -1.0, column, t)
        self.alpha -= t * self.alpha[i]
        for buffer in (self.alpha, self.basis, Q, C):
            buffer[i], buffer[last] = buffer[last], 0.0
        for matrix in (Q, C):
            matrix[:, i], matrix[:, last] = matrix[:, last], 0.0
        self.size = last


def _add_outer(matrix: np.ndarray, factor: float, left: np.ndarray, right: np.ndarray) -> None:
    dger(factor, left, right, a=matrix, overwrite_a=1)


PEERS: dict[str, Callable[[Stream, int], Peer]] = {
    OURS: Sparse,
    "GPyTorch fantasies": Fantasies,
    "scikit-learn refits": Refits,
    "textbook recursion": Recursion,
    "recursion in place": InPlaceRecursion,
}
WINDOWS = ("GPyTorch fantasies", "scikit-learn refits")  # keep the newest points, and forget the others


def accuracy(peer: Peer, stream: Stream) -> tuple[float, float]:
    """Root mean squared error and negative log predictive density on the test set; NaN if variances fail."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # scikit-learn sets negative variances to 0 and says so
        mean, variance = peer.predict(stream.test_inputs)
    error, variance = stream.test_targets - mean, variance + stream.noise_variance
    density = 0.5 * (error.square() / variance + (2 * math.pi * variance).log())
    return float(error.square().mean().sqrt()), float(density.mean())
