"""Temporal differences as observations: GPTD on the sparse state, against dense linear algebra."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import GaussianInputs, SquaredExponential

DISCOUNT, NOISE = 0.9, 0.04
F64 = torch.float64


def chain(steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points x_0 … x_n of an episode, its rewards, and its discounts, 0 at the terminal step."""
    points = torch.cat(
        [torch.linspace(0, 3, steps + 1, dtype=F64)[:, None], torch.rand(steps + 1, 1, dtype=F64)], 1
    )
    discount = torch.full((steps,), DISCOUNT, dtype=F64)
    discount[-1] = 0
    return points, torch.randn(steps, dtype=F64), discount


def dense(kernel: SquaredExponential, points: Tensor, rewards: Tensor, discount: Tensor, query: Tensor):
    """Mean and variance of f given r = H f + noise, H the difference of successive values."""
    steps = len(rewards)
    H = torch.eye(steps, dtype=F64) - torch.diag(discount[:-1], 1)
    K, k = kernel(points[:-1], points[:-1]), kernel(query, points[:-1]) @ H.T
    S = H @ K @ H.T + NOISE * torch.eye(steps, dtype=F64)
    return k @ torch.linalg.solve(S, rewards), kernel.diag(query) - (k * torch.linalg.solve(S, k.T).T).sum(-1)


@pytest.mark.parametrize("blocks", [1, 3, 30])
def test_with_everything_in_the_basis_it_is_dense_gptd(blocks: int) -> None:
    points, rewards, discount = chain(30)
    kernel = SquaredExponential(2, 0.7)
    gp = SparseOnlineGP(kernel, 60, NOISE, novelty_threshold=0)
    gp.update(points[:-1], torch.zeros(30, dtype=F64))  # fills the basis
    gp.forget()
    for part in torch.arange(30).chunk(blocks):
        gp.update(points[part], rewards[part], next_inputs=points[part + 1], discount=discount[part])
    query = torch.rand(20, 2, dtype=F64) * 3
    mean, variance = dense(kernel, points, rewards, discount, query)
    torch.testing.assert_close(gp.posterior(query).mean, mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(gp.posterior(query).variance, variance, rtol=0, atol=1e-9)


def test_with_correlated_noise_it_would_be_regression_on_returns_and_without_discount_it_is_regression() -> (
    None
):
    points, rewards, _ = chain(20)
    plain, differences = (SparseOnlineGP(SquaredExponential(2, 0.7), 40, NOISE) for _ in range(2))
    plain.update(points[:-1], rewards)
    differences.update(points[:-1], rewards, next_inputs=points[1:], discount=0.0)
    torch.testing.assert_close(differences.posterior(points).mean, plain.posterior(points).mean)
    torch.testing.assert_close(differences.log_marginal_likelihood(), plain.log_marginal_likelihood())


def test_what_follows_a_terminal_step_may_hold_anything() -> None:
    points, rewards, discount = chain(10)
    after = points[1:].clone()
    first = SparseOnlineGP(SquaredExponential(2, 0.7), 40, NOISE)
    first.update(points[:-1], rewards, next_inputs=after, discount=discount)
    after[-1] = torch.nan
    second = SparseOnlineGP(SquaredExponential(2, 0.7), 40, NOISE)
    second.update(points[:-1], rewards, next_inputs=after, discount=discount)
    torch.testing.assert_close(first.posterior(points).mean, second.posterior(points).mean, rtol=0, atol=0)


def test_bad_successors_are_refused_and_change_nothing() -> None:
    points, rewards, discount = chain(10)
    gp = SparseOnlineGP(SquaredExponential(2, 0.7), 40, NOISE)
    after = points[1:].clone()
    after[3] = torch.inf
    with pytest.raises(ValueError, match="finite"):
        gp.update(points[:-1], rewards, next_inputs=after, discount=discount)
    spread = torch.full((10, 1), torch.nan, dtype=F64)
    with pytest.raises(ValueError, match="variance of next_inputs must be finite"):
        gp.update(
            points[:-1], rewards, next_inputs=GaussianInputs(points[1:], spread, (1,)), discount=discount
        )
    assert int(gp.size) == 0
    assert int(gp.observations) == 0


def quadrature(points: Tensor, variance: float, nodes: int = 40) -> tuple[Tensor, Tensor]:
    """Points with their last column at Gauss-Hermite nodes, [nodes, N, D], and the weights."""
    z, w = (torch.from_numpy(a) for a in np.polynomial.hermite_e.hermegauss(nodes))
    spread = points.expand(nodes, *points.shape).clone()
    spread[..., -1] += math.sqrt(variance) * z[:, None]
    return spread, w / w.sum()


def test_the_posterior_of_an_average_is_the_average_of_the_posterior() -> None:
    points, rewards, _ = chain(25)
    gp = SparseOnlineGP(SquaredExponential(2, 0.7), 60, NOISE)
    gp.update(points[:-1], rewards)
    variance = 0.3
    average = gp.posterior(GaussianInputs(points, torch.full((26, 1), variance, dtype=F64), (1,)))
    nodes, weights = quadrature(points, variance)
    mean = sum(w * gp.posterior(x).mean for w, x in zip(weights, nodes, strict=True))
    torch.testing.assert_close(average.mean, mean, rtol=0, atol=1e-8)
    for i in (0, 13, 25):  # Var E_a f = wᵀ Cov w
        covariance = gp.joint(nodes[:, i]).covariance_matrix
        torch.testing.assert_close(average.variance[i], weights @ covariance @ weights, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        gp.mean(GaussianInputs(points, average.mean.new_full((26, 1), variance), (1,))), mean
    )


def test_averaged_successors_are_many_weighted_successors() -> None:
    points, rewards, discount = chain(15)
    kernel = SquaredExponential(2, 0.7)
    gp = SparseOnlineGP(kernel, 60, NOISE, novelty_threshold=0)
    gp.update(points, torch.zeros(16, dtype=F64))
    gp.forget()
    gp.novelty_threshold = torch.inf
    after = GaussianInputs(points[1:], torch.full((15, 1), 0.2, dtype=F64), (1,))
    gp.update(points[:-1], rewards, next_inputs=after, discount=discount)
    # the same on the fixed basis, by quadrature: weights e = K⁻¹(k(x) − γ E k(x')), residual from the prior
    nodes, weights = quadrature(points[1:], 0.2)
    basis, size = gp.basis[:16], 16
    gram = kernel(basis, basis)
    mean_k = sum(w * kernel(basis, x) for w, x in zip(weights, nodes, strict=True))
    k = kernel(basis, points[:-1]) - discount * mean_k
    cross = sum(w * (kernel(points[:-1], x)).diagonal() for w, x in zip(weights, nodes, strict=True))
    both = torch.stack([weights @ kernel(nodes[:, i], nodes[:, i]) @ weights for i in range(15)])
    prior = 1 - 2 * discount * cross + discount**2 * both
    e = torch.linalg.solve(gram, k)
    weight = 1 / (NOISE + prior - (k * e).sum(0))
    precision = torch.linalg.inv(gram) + (e * weight) @ e.T
    mean = torch.linalg.solve(precision, e @ (weight * rewards))
    assert int(gp.size) == size
    torch.testing.assert_close(gp.posterior(basis).mean, mean, rtol=1e-5, atol=1e-6)


def test_a_batch_of_learners_learns_differences_as_each_alone() -> None:
    parts = [chain(40) for _ in range(3)]
    points, rewards, discount = (torch.stack(column) for column in zip(*parts, strict=True))
    batch = SparseOnlineGP(SquaredExponential(2, 0.4, batch_shape=(3,)), 12, NOISE, overshoot=1)
    batch.update(points[:, :-1], rewards, next_inputs=points[:, 1:], discount=discount)
    for i in range(3):
        alone = SparseOnlineGP(SquaredExponential(2, 0.4), 12, NOISE, overshoot=1)
        alone.update(points[i, :-1], rewards[i], next_inputs=points[i, 1:], discount=discount[i])
        torch.testing.assert_close(
            batch.posterior(points).mean[i], alone.posterior(points[i]).mean, rtol=0, atol=1e-8
        )


def test_a_batch_that_fills_its_buffers_bit_by_bit_learns_as_each_alone() -> None:
    # the rows in use grow past three quarters of the buffers within an update
    inputs = torch.randn(12, 2, 7, 2, dtype=F64)
    batch = SparseOnlineGP(SquaredExponential(2, 0.3, batch_shape=(2,)), 40, NOISE)
    alone = SparseOnlineGP(SquaredExponential(2, 0.3), 40, NOISE)
    for x in inputs:
        batch.update(x, x[..., 0], next_inputs=x + 0.1, discount=0.9)
        alone.update(x[1], x[1, :, 0], next_inputs=x[1] + 0.1, discount=0.9)
    torch.testing.assert_close(batch.size[1], alone.size)
    query = torch.randn(2, 9, 2, dtype=F64)
    torch.testing.assert_close(batch.posterior(query).mean[1], alone.posterior(query[1]).mean)
