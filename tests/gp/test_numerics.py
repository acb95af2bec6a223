"""Long streams of near duplicates, and short numbers: what rounding may do to the sparse process."""

import copy

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from torch_gprl.gp import ExactGP, Posterior, SparseOnlineGP
from torch_gprl.kernels import SquaredExponential

NOISE = 0.01
NEVER = 1e12  # a novelty threshold that no point exceeds
CENTRES = torch.rand(40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
LONG = [pytest.param(100_000, id="1e5"), pytest.param(1_000_000, id="1e6", marks=pytest.mark.slow)]


def near_duplicates(count: int) -> tuple[Tensor, Tensor]:
    """Points that lie up to 1e-6 beside one of 40 others, with noisy values of a function."""
    inputs = CENTRES[torch.randint(len(CENTRES), (count,))] + 1e-6 * torch.randn(
        count, 2, dtype=torch.float64
    )
    return inputs, (3 * inputs).sin().sum(-1) + NOISE**0.5 * torch.randn(count, dtype=torch.float64)


def sparse(budget: int = 60, threshold: float = 0.3, dtype: torch.dtype = torch.float64) -> SparseOnlineGP:
    kernel = SquaredExponential(2, 0.3, 1.5).to(dtype)
    return SparseOnlineGP(kernel, budget, NOISE, threshold).requires_grad_(False)


class SquareRoot:
    """The process on a fixed basis by orthogonal triangularisation, in NumPy and SciPy.

    With w ~ N(0, I) for whitened basis values and rows φᵀ/√(σ0² + ν) for data, R is the triangle of the QR
    factorisation of [I; rows], and z of the equally rotated right side. No matrix is ever squared.
    """

    def __init__(self, basis: np.ndarray, lengthscale: float, outputscale: float) -> None:
        self.basis, self.lengthscale, self.outputscale = basis, lengthscale, outputscale
        self.gram_factor = np.linalg.cholesky(self.kernel(basis))
        self.root = np.hstack([np.eye(len(basis)), np.zeros((len(basis), 1))])  # [R | z]

    def kernel(self, points: np.ndarray) -> np.ndarray:
        difference = (self.basis[:, None] - points) / self.lengthscale
        return self.outputscale * np.exp(-0.5 * np.square(difference).sum(-1))

    def features(self, points: np.ndarray) -> np.ndarray:
        return scipy.linalg.solve_triangular(self.gram_factor, self.kernel(points), lower=True)

    def update(self, inputs: np.ndarray, targets: np.ndarray) -> None:
        features = self.features(inputs)
        novelty = self.outputscale - np.square(features).sum(0)
        rows = np.vstack([features, targets]).T / np.sqrt(NOISE + novelty)[:, None]
        self.root = np.linalg.qr(np.vstack([self.root, rows]), mode="r")[: len(self.basis)]

    def posterior(self, points: np.ndarray) -> Posterior:
        features = self.features(points)
        half = scipy.linalg.solve_triangular(self.root[:, :-1], features, trans=1)  # R⁻ᵀφ
        mean = half.T @ self.root[:, -1]
        variance = self.outputscale - np.square(features).sum(0) + np.square(half).sum(0)
        return Posterior(torch.from_numpy(mean), torch.from_numpy(variance))


def assert_healthy(gp: SparseOnlineGP, points: Tensor) -> None:
    """Variances are not negative, the precision is symmetric, and data have added to the prior's, I."""
    assert (gp.posterior(points).variance >= 0).all()
    asymmetry = (gp.precision - gp.precision.mT).abs().max() / gp.precision.abs().max()
    assert asymmetry <= 1e-14
    assert torch.linalg.eigvalsh(gp.precision)[0] >= 1 - 1e-9


@pytest.mark.parametrize("count", LONG)
def test_a_long_stream_of_near_duplicates_agrees_with_the_square_root_filter(count):
    gp = sparse()
    start = near_duplicates(200)
    gp.update(*start)
    size = int(gp.size)
    gp.novelty_threshold = NEVER
    reference = SquareRoot(gp.basis[:size].numpy(), 0.3, 1.5)
    reference.update(start[0].numpy(), start[1].numpy())
    for _ in range(count // 1000):
        inputs, targets = near_duplicates(1000)
        gp.update(inputs, targets)
        reference.update(inputs.numpy(), targets.numpy())
    points = torch.cat([inputs, gp.basis[:size], torch.rand(200, 2, dtype=torch.float64)])
    assert_healthy(gp, points)
    for mine, theirs in zip(gp.posterior(points), reference.posterior(points.numpy()), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("count", LONG)
def test_pruning_over_a_long_stream_of_near_duplicates_keeps_the_state_healthy(count):
    gp = sparse(budget=20, threshold=0.0)  # fewer vectors than centres, and every duplicate wants to join
    for _ in range(count // 1000):
        inputs, targets = near_duplicates(1000)
        gp.update(inputs, targets)
    points = torch.cat([inputs, gp.basis[: int(gp.size)], torch.rand(200, 2, dtype=torch.float64)])
    assert_healthy(gp, points)
    assert gp.size >= 20
    assert (gp.posterior(CENTRES).mean - (3 * CENTRES).sin().sum(-1)).square().mean().sqrt() < 0.3


def test_points_in_float32_are_cast_at_the_door():
    inputs, targets = near_duplicates(300)
    inputs, targets = inputs.float(), targets.float()
    short, long = sparse(), sparse()
    short.update(inputs, targets)
    long.update(inputs.double(), targets.double())
    for mine, theirs in zip(short.posterior(inputs), long.posterior(inputs.double()), strict=True):
        assert mine.dtype == torch.float64
        assert torch.equal(mine, theirs)
    assert short.joint(inputs[:5]).mean.dtype == short.mean(inputs).dtype == torch.float64


@pytest.mark.parametrize("threshold", [0.0, 0.3])
def test_a_float32_process_warns_and_keeps_half_of_the_digits(threshold):
    with pytest.warns(UserWarning, match="float32"):
        gp = sparse(threshold=threshold, dtype=torch.float32)
    twin = sparse(threshold=threshold)
    for _ in range(10):
        inputs, targets = near_duplicates(1000)
        gp.update(inputs, targets)
        twin.update(inputs, targets)
    points = torch.cat([inputs, torch.rand(200, 2, dtype=torch.float64)])
    mean, variance = gp.posterior(points)
    assert mean.dtype == torch.float32
    assert (variance >= 0).all()
    if (
        threshold == 0
    ):  # its floor under novelty is higher, and what it leaves out is missed far from the data
        assert gp.size < twin.size
    else:
        expected = twin.posterior(points)
        torch.testing.assert_close(mean.double(), expected.mean, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(variance.double(), expected.variance, rtol=1e-4, atol=1e-4)


def test_a_trained_process_moves_to_float32_and_back_with_its_state():
    gp, (inputs, targets) = sparse(threshold=0.3), near_duplicates(2000)
    gp.update(inputs, targets)
    long = gp.posterior(inputs)
    with pytest.warns(UserWarning, match="float32"):
        short = copy.deepcopy(gp).float()
    with pytest.warns(UserWarning, match="float32"):
        other = sparse(dtype=torch.float32)
    other.load_state_dict(short.state_dict())
    for mine, loaded, theirs in zip(short.posterior(inputs), other.posterior(inputs), long, strict=True):
        assert torch.equal(mine, loaded)
        torch.testing.assert_close(mine.double(), theirs, rtol=1e-2, atol=1e-3)
    short.double().update(inputs, targets)
    gp.update(inputs, targets)
    torch.testing.assert_close(short.posterior(inputs).mean, gp.posterior(inputs).mean, rtol=1e-3, atol=1e-3)


def test_far_from_the_origin_nothing_is_lost():
    inputs, targets = near_duplicates(500)
    near, far = sparse(), sparse()
    near.update(inputs, targets)
    far.update(inputs + 1e4, targets)
    exact = ExactGP(near.kernel, NOISE).requires_grad_(False).fit(inputs, targets).posterior(CENTRES)
    for here, there, dense in zip(near.posterior(CENTRES), far.posterior(CENTRES + 1e4), exact, strict=True):
        torch.testing.assert_close(here, there, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(here, dense, rtol=1e-2, atol=1e-2)


def test_where_covariances_underflow_mean_and_variance_have_no_slope_and_no_curvature():
    gp = sparse()
    gp.update(*near_duplicates(100))
    far = torch.full((1, 2), 1e3, dtype=torch.float64)
    assert tuple(map(float, gp.posterior(far))) == (0.0, float(gp.kernel.diag(far)))
    for part in (0, 1):
        hessian = torch.autograd.functional.hessian(lambda x, part=part: gp.posterior(x)[part].sum(), far)
        assert torch.equal(hessian, torch.zeros_like(hessian))
