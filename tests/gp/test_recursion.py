"""The point-by-point recursion against batch formulas: the ground on which the fast process is tested."""

from typing import Literal

import pytest
import torch
from torch import Tensor

from torch_gprl.gp import ExactGP, RecursiveGP
from torch_gprl.kernels import Kernel, Matern, SquaredExponential

NOISE = 0.2
Projection = Literal["moment", "dtc"]
PROJECTIONS: tuple[Projection, ...] = ("moment", "dtc")
KERNEL = SquaredExponential(2, [0.8, 1.2], 1.5).requires_grad_(False)


def sample(count: int) -> tuple[Tensor, Tensor]:
    inputs = torch.randn(count, 2, dtype=torch.float64)
    return inputs, inputs.sin().sum(-1) + NOISE**0.5 * torch.randn(count, dtype=torch.float64)


def recursion(
    budget: int = 100,
    threshold: float = 0.0,
    projection: Projection = "moment",
    score: Literal["mean", "kl"] = "mean",
) -> RecursiveGP:
    return RecursiveGP(KERNEL, budget, NOISE, threshold, projection, score)


def trained(count: int = 30, projection: Projection = "moment", threshold: float = 0.5) -> RecursiveGP:
    gp = recursion(threshold=threshold, projection=projection)
    gp.update(*sample(count))
    return gp


@pytest.mark.parametrize("kernel", [KERNEL, Matern(2).requires_grad_(False)], ids=["smooth", "rough"])
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_with_every_point_added_it_is_the_dense_process(kernel: Kernel, projection: Projection):
    inputs, targets = sample(25)
    gp = RecursiveGP(kernel, 100, NOISE, 0.0, projection)
    gp.update(inputs, targets)
    inverse = torch.linalg.inv(kernel(inputs, inputs) + NOISE * torch.eye(25).double())
    assert gp.size == 25
    torch.testing.assert_close(gp.alpha, inverse @ targets, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(gp.C, -inverse, rtol=1e-10, atol=1e-10)
    points = sample(9)[0]
    exact = ExactGP(kernel, NOISE).fit(inputs, targets).posterior(points)
    torch.testing.assert_close(gp.posterior(points).mean, exact.mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(gp.posterior(points).variance, exact.variance, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_on_a_fixed_basis_moment_is_fitc_and_dtc_is_dtc(projection: Projection):
    (basis, first), (inputs, targets) = sample(8), sample(40)
    gp = recursion(projection=projection)
    gp.update(basis, first)
    gp.novelty_threshold = 1e12
    gp.update(inputs, targets)
    # Quiñonero-Candela and Rasmussen (2005), equations (20b) and (24b), on all 48 points
    x, y = torch.cat([basis, inputs]), torch.cat([first, targets])
    Kmm, Kmn = KERNEL(basis, basis), KERNEL(basis, x)
    residual = KERNEL.diag(x) - (Kmn * torch.linalg.solve(Kmm, Kmn)).sum(0)
    noise = NOISE + residual * (projection == "moment")
    S = torch.linalg.inv(Kmm + (Kmn / noise) @ Kmn.mT)
    torch.testing.assert_close(gp.alpha, S @ (Kmn / noise) @ y, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(gp.C, S - torch.linalg.inv(Kmm), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_adding_a_point_and_deleting_it_is_projecting_it(projection: Projection):
    inputs, targets = sample(12)
    new, target = sample(1)
    added, projected = recursion(projection=projection), recursion(projection=projection)
    for gp in (added, projected):
        gp.update(inputs, targets)
    added.update(new, target)
    assert added.size == 13
    added.delete(12)
    projected.novelty_threshold = 1e12
    projected.update(new, target)
    torch.testing.assert_close(added.alpha, projected.alpha, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(added.C, projected.C, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(added.gram_inverse, projected.gram_inverse, rtol=1e-9, atol=1e-9)


def test_a_deletion_leaves_the_posterior_at_the_other_basis_vectors_alone():
    gp = trained()
    rest = torch.cat([gp.basis[:3], gp.basis[4:]])
    before = gp.posterior(rest)
    gp.delete(3)
    assert torch.equal(gp.basis, rest)
    torch.testing.assert_close(gp.posterior(rest).mean, before.mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(gp.posterior(rest).variance, before.variance, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_gram_inverse_stays_the_inverse_and_signs_stay_right(projection: Projection):
    gp = recursion(budget=10, threshold=0.3, projection=projection)
    gp.update(*sample(80))
    identity = torch.eye(gp.size, dtype=torch.float64)
    torch.testing.assert_close(gp.gram_inverse @ KERNEL(gp.basis, gp.basis), identity, rtol=0, atol=1e-9)
    assert torch.linalg.eigvalsh(gp.C)[-1] <= 1e-12  # C ⪯ 0
    assert torch.linalg.eigvalsh(gp.gram_inverse + gp.C)[0] > 0  # K⁻¹ + C ≻ 0


def test_the_variance_does_not_depend_on_targets():
    inputs, targets = sample(40)
    one, other = recursion(threshold=0.5), recursion(threshold=0.5)
    one.update(inputs, targets)
    other.update(inputs, 100 * torch.randn_like(targets))
    points = sample(20)[0]
    torch.testing.assert_close(one.posterior(points).variance, other.posterior(points).variance)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_learning_without_deletion_never_raises_the_variance(projection: Projection):
    gp, points = recursion(threshold=0.5, projection=projection), sample(50)[0]
    variance = gp.posterior(points).variance
    torch.testing.assert_close(variance, KERNEL.diag(points))  # the prior
    for point, target in zip(*sample(40), strict=True):
        gp.update(point[None], target[None])
        after = gp.posterior(points).variance
        assert (after <= variance + 1e-12).all()
        variance = after


def test_repeats_of_one_input_average_and_shrink():
    gp, point = recursion(), torch.ones(1, 2, dtype=torch.float64)
    targets = torch.tensor([1.0, 4.0, -2.0], dtype=torch.float64)
    gp.update(point.expand(3, 2), targets)
    assert gp.size == 1  # a seen point is not novel
    assert gp.posterior(point).mean.item() == pytest.approx(3.0 / (3 + NOISE / 1.5))  # Σy/(n + σ²/A)


@pytest.mark.parametrize(("distance", "size"), [(1e-4, 2), (1e-6, 1)])
def test_without_a_threshold_roundoff_still_adds_no_basis_vector(distance: float, size: int):
    point, target = sample(1)
    gp = recursion(threshold=0.0)
    gp.update(torch.cat([point, point + distance]), target.expand(2))  # novelty about 3 · distance²
    assert gp.size == size


def test_a_point_joins_the_basis_just_above_the_threshold_and_not_just_below():
    basis, target = sample(1)
    new = basis + 0.5
    novelty = (KERNEL.diag(new) - KERNEL(new, basis).square() / KERNEL.diag(basis)).item()
    for factor, size in ((0.999, 2), (1.001, 1)):
        gp = recursion(threshold=factor * novelty / NOISE)
        gp.update(torch.cat([basis, new]), target.expand(2))
        assert gp.size == size


def test_the_basis_stays_within_budget_and_loses_the_smallest_score():
    inputs, targets = sample(11)
    full, pruned = recursion(), recursion(budget=10)
    full.update(inputs, targets)
    pruned.update(inputs, targets)
    victim = int(full.scores().argmin())
    assert pruned.size == 10
    assert torch.equal(pruned.basis, torch.cat([inputs[:victim], inputs[victim + 1 :]]))


def test_the_mean_score_is_the_squared_change_of_the_mean_at_the_vector_that_goes():
    gp = trained()
    score, where = gp.scores()[5], gp.basis[5:6]
    before = gp.posterior(where).mean
    gp.delete(5)
    torch.testing.assert_close((gp.posterior(where).mean - before).square().squeeze(), score)


def test_the_kl_score_is_the_squared_signal_to_noise_ratio_of_a_coefficient():
    # f = Σ_i c_i k(·, x_i) on the basis with c = K⁻¹u: the score is E[c_i]²/var[c_i]
    inputs, targets = sample(10)
    gp = recursion(score="kl")
    gp.update(inputs, targets)
    with torch.no_grad():
        values = ExactGP(KERNEL, NOISE).fit(inputs, targets).joint(inputs)
    inverse = torch.linalg.inv(KERNEL(inputs, inputs))
    mean, covariance = inverse @ values.mean, inverse @ values.covariance_matrix @ inverse
    torch.testing.assert_close(gp.scores(), mean.square() / covariance.diagonal(), rtol=1e-6, atol=1e-9)
