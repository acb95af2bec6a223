"""The sparse online process against the dense one, batch formulas, the recursion, and the laws of Bayes."""

import copy
from typing import Any, Literal

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from torch_gprl.gp import BasisStatistics, ExactGP, InformationScore, Posterior, RecursiveGP, SparseOnlineGP
from torch_gprl.kernels import Kernel, Matern, SquaredExponential

NOISE = 0.2
NEVER = 1e12  # a novelty threshold that no point exceeds
Projection = Literal["moment", "dtc"]
PROJECTIONS: tuple[Projection, ...] = ("moment", "dtc")
KERNEL = SquaredExponential(2, [0.8, 1.2], 1.5).requires_grad_(False)


def sample(*shape: int) -> tuple[Tensor, Tensor]:
    """Points [*shape, 2] and noisy values of a function there."""
    inputs = torch.randn(*shape, 2, dtype=torch.float64)
    return inputs, inputs.sin().sum(-1) + NOISE**0.5 * torch.randn(shape, dtype=torch.float64)


def sparse(
    budget: int = 60, threshold: float = 0.0, kernel: Kernel = KERNEL, **options: Any
) -> SparseOnlineGP:
    return SparseOnlineGP(kernel, budget, NOISE, threshold, **options).requires_grad_(False)


def fixed(projection: Projection = "moment") -> SparseOnlineGP:
    """A process that has learned 8 points, all in its basis, and will admit no other."""
    gp = sparse(projection=projection)
    gp.update(*sample(8))
    gp.novelty_threshold = NEVER
    return gp


def assert_same(one: Posterior, other: Posterior, tolerance: float = 1e-10) -> None:
    for mine, theirs in zip(one, other, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=tolerance)


def used(gp: SparseOnlineGP) -> tuple[Tensor, Tensor, Tensor]:
    """Basis, α and C without the unused rows."""
    size = int(gp.size)
    return gp.basis[:size], gp.alpha[:size], gp.C[:size, :size]


# ---------------------------------------------------------------- agreement with other computations


@pytest.mark.parametrize("kernel", [KERNEL, Matern(2).requires_grad_(False)], ids=["smooth", "rough"])
@pytest.mark.parametrize("order", ["novelty", "arrival"])
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_with_nothing_dropped_it_is_the_dense_process(kernel, order, projection):
    inputs, targets = sample(40)
    gp = sparse(kernel=kernel, order=order, projection=projection)
    gp.update(inputs, targets)
    exact = ExactGP(kernel, NOISE).fit(inputs, targets).requires_grad_(False)
    points = sample(20)[0]
    assert gp.size == 40
    assert_same(gp.posterior(points), exact.posterior(points))
    basis, _, C = used(gp)
    noisy = kernel(basis, basis) + NOISE * torch.eye(40, dtype=torch.float64)
    torch.testing.assert_close(C, -torch.linalg.inv(noisy), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        gp.log_marginal_likelihood(), exact.log_marginal_likelihood(), rtol=1e-10, atol=1e-10
    )


def test_in_order_of_arrival_alpha_weighs_the_points_as_they_came():
    inputs, targets = sample(30)
    gp = sparse(order="arrival")
    gp.update(inputs, targets)
    noisy = KERNEL(inputs, inputs) + NOISE * torch.eye(30, dtype=torch.float64)
    basis, alpha, _ = used(gp)
    assert torch.equal(basis, inputs)
    torch.testing.assert_close(alpha, torch.linalg.solve(noisy, targets), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_on_a_fixed_basis_moment_is_fitc_and_dtc_is_dtc(projection):
    (first, first_targets), (inputs, targets) = sample(8), sample(300)
    gp = sparse(projection=projection)
    gp.update(first, first_targets)
    gp.novelty_threshold = NEVER
    gp.update(inputs, targets)
    basis, alpha, C = used(gp)
    # Quiñonero-Candela and Rasmussen (2005), equations (20b) and (24b), on all 308 points
    x, y = torch.cat([first, inputs]), torch.cat([first_targets, targets])
    Kmm, Kmn = KERNEL(basis, basis), KERNEL(basis, x)
    Qnn = Kmn.mT @ torch.linalg.solve(Kmm, Kmn)
    noise = NOISE + (KERNEL.diag(x) - Qnn.diagonal()) * (projection == "moment")
    S = torch.linalg.inv(Kmm + (Kmn / noise) @ Kmn.mT)
    torch.testing.assert_close(alpha, S @ (Kmn / noise) @ y, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(C, S - torch.linalg.inv(Kmm), rtol=1e-9, atol=1e-9)
    evidence = MultivariateNormal(torch.zeros_like(y), Qnn + noise.diag()).log_prob(y)
    torch.testing.assert_close(gp.log_marginal_likelihood(), evidence, rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("kind", ["mean", "kl"])
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_in_order_of_arrival_it_is_the_recursion_also_when_it_prunes(projection, kind):
    inputs, targets = sample(80)
    twin = RecursiveGP(KERNEL, 12, NOISE, 0.3, projection, kind)
    gp = sparse(12, 0.3, order="arrival", overshoot=1, projection=projection, pruning=InformationScore(kind))
    points = sample(20)[0]
    for part in range(0, 80, 20):
        gp.update(inputs[part : part + 20], targets[part : part + 20])
        twin.update(inputs[part : part + 20], targets[part : part + 20])
        assert_same(gp.posterior(points), twin.posterior(points), 1e-8)
    assert gp.size == 12
    basis, alpha, C = used(gp)
    assert torch.equal(basis, twin.basis)
    torch.testing.assert_close(alpha, twin.alpha, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(C, twin.C, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_on_a_fixed_basis_a_block_equals_its_points_in_any_order(projection):
    block, points = fixed(projection), sample(20)[0]
    singly = copy.deepcopy(block)
    inputs, targets = sample(300)
    block.update(inputs, targets)
    for index in torch.randperm(300).tolist():
        singly.update(inputs[index : index + 1], targets[index : index + 1])
    assert_same(block.posterior(points), singly.posterior(points))
    torch.testing.assert_close(block.log_marginal_likelihood(), singly.log_marginal_likelihood())
    assert block.observations == singly.observations == 308


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_two_halves_merged_equal_the_whole(projection):
    first, inputs, targets = sample(8), *sample(60)
    halves = [sparse(projection=projection) for _ in range(2)]
    whole = sparse(projection=projection)
    for gp in (whole, *halves):
        gp.update(*first)
        gp.novelty_threshold = NEVER
    for half, part in zip(halves, (slice(30), slice(30, 60)), strict=True):
        half.update(inputs[part], targets[part])
    whole.update(*first)  # merging adds: what both halves have seen counts twice
    whole.update(inputs, targets)
    halves[0].merge(halves[1])
    points = sample(20)[0]
    assert_same(halves[0].posterior(points), whole.posterior(points))
    torch.testing.assert_close(halves[0].log_marginal_likelihood(), whole.log_marginal_likelihood())
    assert halves[0].observations == whole.observations


def test_different_bases_do_not_merge():
    one, other = fixed(), fixed()
    before = one.state_dict()
    with pytest.raises(ValueError, match="merge needs one basis"):
        one.merge(other)
    assert all(torch.equal(before[key], tensor) for key, tensor in one.state_dict().items())


@pytest.mark.parametrize("order", ["novelty", "arrival"])
def test_each_learner_of_a_batch_is_a_process_of_its_own(order):
    lengthscales = torch.tensor([[0.3], [1.0], [4.0]], dtype=torch.float64)
    noises = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    kernel = Matern(2, lengthscales, [1.0, 2.0, 0.5], batch_shape=(3,))
    batch = SparseOnlineGP(kernel, 15, noises, order=order, overshoot=1)
    points = sample(3, 10)[0]
    streams = [sample(3, 40) for _ in range(4)]
    for stamp, stream in enumerate(streams):
        batch.update(*stream, stamp=stamp)
    for learner, (lengthscale, outputscale, noise) in enumerate([(0.3, 1, 0.1), (1, 2, 0.2), (4, 0.5, 0.3)]):
        single = SparseOnlineGP(Matern(2, lengthscale, outputscale), 15, noise, order=order, overshoot=1)
        for stamp, (inputs, targets) in enumerate(streams):
            single.update(inputs[learner], targets[learner], stamp=stamp)
        assert single.size == batch.size[learner]
        assert torch.equal(single.basis, batch.basis[learner])
        assert torch.equal(single.stamps, batch.stamps[learner])
        posterior = batch.posterior(points)
        expected = single.posterior(points[learner])
        assert_same(Posterior(posterior.mean[learner], posterior.variance[learner]), expected, 1e-8)


# ---------------------------------------------------------------- laws


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_learning_never_raises_the_variance_whatever_the_targets(projection):
    gp, points = sparse(threshold=0.5, projection=projection), sample(50)[0]
    other = copy.deepcopy(gp)
    variance = gp.posterior(points).variance
    torch.testing.assert_close(variance, KERNEL.diag(points))  # the prior
    for _ in range(10):
        inputs, targets = sample(5)
        gp.update(inputs, targets)
        other.update(inputs, 100 * torch.randn_like(targets))
        after = gp.posterior(points).variance
        assert (after <= variance + 1e-12).all()
        assert torch.equal(after, other.posterior(points).variance)
        variance = after
    assert torch.linalg.eigvalsh(gp.C)[-1] <= 1e-12  # C ⪯ 0


def test_repeats_of_one_input_average_and_shrink():
    point = torch.ones(1, 2, dtype=torch.float64)
    targets = torch.tensor([1.0, 4.0, -2.0], dtype=torch.float64)
    gp = sparse()
    gp.update(point.expand(3, 2), targets)
    mean, variance = gp(point)
    assert gp.size == 1  # a seen point adds no basis vector
    assert mean.item() == pytest.approx(3.0 / (3 + NOISE / 1.5))  # Σy/(n + σ²/A)
    assert variance.item() == pytest.approx(1 / (1 / 1.5 + 3 / NOISE))


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_adding_a_point_and_deleting_it_is_projecting_it(projection):
    def newest_goes(statistics: BasisStatistics) -> Tensor:
        return -statistics.stamps.double()

    inputs, targets = sample(12)
    new = sample(1)
    deleting = sparse(12, overshoot=1, projection=projection, pruning=newest_goes)
    projecting = sparse(12, projection=projection)
    for gp in (deleting, projecting):
        gp.update(inputs, targets, stamp=0)
    projecting.novelty_threshold = NEVER
    for gp in (deleting, projecting):
        gp.update(*new, stamp=1)
    assert deleting.size == 12
    assert torch.equal(used(deleting)[0], used(projecting)[0])
    points = sample(20)[0]
    assert_same(deleting.posterior(points), projecting.posterior(points), 1e-9)


def test_the_basis_stays_within_the_buffers_and_comes_back_to_the_budget():
    gp = sparse(10, overshoot=4)
    sizes = []
    for count in [64] * 5 + [8] * 20:  # every point is novel
        gp.update(*sample(count))
        sizes.append(int(gp.size))
    assert 10 <= min(sizes) <= max(sizes) <= 14 == gp.capacity
    assert sizes.count(10) in range(3, len(sizes) // 2)  # rounds of pruning, not one a block


def test_a_point_joins_the_basis_just_above_the_threshold_and_not_just_below():
    basis, target = sample(1)
    new = basis + 0.5
    novelty = (KERNEL.diag(new) - KERNEL(new, basis).square() / KERNEL.diag(basis)).item()
    for factor, size in ((0.999, 2), (1.001, 1)):
        gp = sparse(threshold=factor * novelty / NOISE)
        gp.update(basis, target)
        gp.update(new, target)
        assert gp.size == size


def test_near_duplicates_keep_variances_positive_and_the_mean_exact():
    centres = sample(10)[0]
    gp = sparse(40)
    inputs = centres[torch.randint(10, (2000,))] + 1e-6 * torch.randn(2000, 2, dtype=torch.float64)
    targets = inputs.sin().sum(-1) + NOISE**0.5 * torch.randn(2000, dtype=torch.float64)
    gp.update(inputs, targets)
    points = torch.cat([inputs, gp.basis[: int(gp.size)]])
    mean, variance = gp.posterior(points)
    assert (variance > 0).all()
    exact = ExactGP(KERNEL, NOISE).fit(inputs, targets).requires_grad_(False).posterior(centres)
    assert_same(gp.posterior(centres), exact, 1e-6)
    assert mean.isfinite().all()


# ---------------------------------------------------------------- masks and options


@pytest.mark.parametrize("order", ["novelty", "arrival"])
def test_masked_points_leave_no_trace(order):
    inputs, targets = sample(2, 40)
    mask = torch.rand(2, 40) < 0.5
    masked = sparse(batch_shape=(2,), order=order)
    masked.update(
        torch.where(mask[..., None], inputs, torch.nan), torch.where(mask, targets, torch.inf), mask=mask
    )
    assert torch.equal(masked.observations, mask.sum(-1))
    points = sample(10)[0]
    for learner in range(2):
        plain = sparse(order=order)
        plain.update(inputs[learner, mask[learner]], targets[learner, mask[learner]])
        mean, variance = masked.posterior(points)
        assert_same(Posterior(mean[learner], variance[learner]), plain.posterior(points))
        torch.testing.assert_close(masked.log_marginal_likelihood()[learner], plain.log_marginal_likelihood())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budget": 0}, "budget must be at least 1"),
        ({"overshoot": 0}, "overshoot must be at least 1"),
        ({"threshold": -0.1}, "novelty_threshold must be at least 0"),
        ({"threshold": float("nan")}, "novelty_threshold must be at least 0"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sparse(**options)


@pytest.mark.parametrize("noise", [0.0, -1.0, float("nan"), float("inf")])
def test_a_noise_variance_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match="noise_variance must be positive and finite"):
        SparseOnlineGP(KERNEL, 10, noise)


# ---------------------------------------------------------------- state


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_after_a_kernel_change_the_pseudo_likelihood_stays(projection):
    kernel = SquaredExponential(2, [0.8, 1.2], 1.5).requires_grad_(False)
    gp = sparse(kernel=kernel, projection=projection)
    first, (inputs, targets) = sample(8), sample(40)
    gp.update(*first)
    gp.novelty_threshold = NEVER
    gp.update(inputs, targets)
    # what the data say of f(basis): Λ = Σ e eᵀ/(σ² + ν), h = Σ e y/(σ² + ν), e = K⁻¹k by the old kernel
    basis = used(gp)[0].clone()
    x, y = torch.cat([first[0], inputs]), torch.cat([first[1], targets])
    e = torch.linalg.solve(kernel(basis, basis), kernel(basis, x))
    novelty = kernel.diag(x) - (e * kernel(basis, x)).sum(0)
    noise = NOISE + novelty * (projection == "moment")
    Λ, h = (e / noise) @ e.mT, (e / noise) @ y
    kernel.lengthscale, kernel.outputscale = [1.5, 0.7], 0.6
    evidence = gp.log_marginal_likelihood()
    gp.rebase()
    points = sample(20)[0]
    K, k = kernel(basis, basis), kernel(basis, points)
    S = torch.linalg.inv(torch.linalg.inv(K) + Λ)
    E = torch.linalg.solve(K, k)
    expected = Posterior(E.mT @ S @ h, kernel.diag(points) - (k * E).sum(0) + (E * (S @ E)).sum(0))
    assert_same(gp.posterior(points), expected, 1e-8)
    torch.testing.assert_close(gp.log_marginal_likelihood(), evidence, rtol=1e-8, atol=1e-8)


def test_a_saved_state_gives_the_same_bits_and_learns_on_alike():
    gp, twin = (sparse(20, 0.3, copy.deepcopy(KERNEL)) for _ in range(2))
    more, points = sample(40), sample(10)[0]
    gp.update(*sample(60), stamp=5)
    twin.update(*sample(5))
    twin.posterior(points)
    twin.load_state_dict(copy.deepcopy(gp.state_dict()))
    assert all(map(torch.equal, gp.posterior(points), twin.posterior(points)))
    for process in (gp, twin):
        process.update(*more)
    assert all(map(torch.equal, gp.posterior(points), twin.posterior(points)))
    assert torch.equal(gp.stamps, twin.stamps)


def test_a_reset_forgets_all_but_the_parameters():
    gp, points = sparse(10), sample(10)[0]
    fresh = sparse(10).state_dict()
    gp.update(*sample(40), stamp=7)
    gp.reset()
    assert all(torch.equal(fresh[key], tensor) for key, tensor in gp.state_dict().items())
    assert_same(gp.posterior(points), Posterior(torch.zeros(10).double(), KERNEL.diag(points)))


def test_buffers_keep_their_storage():
    gp = sparse(10)
    before = {name: buffer.data_ptr() for name, buffer in gp.named_buffers()}
    gp.update(*sample(80))
    gp.rebase()
    gp.posterior(sample(3)[0])
    gp.reset()
    assert {name: buffer.data_ptr() for name, buffer in gp.named_buffers()} == before


# ---------------------------------------------------------------- reading


def test_the_ways_to_read_the_posterior_agree():
    gp, points = sparse(12, 0.3), sample(15)[0]
    gp.update(*sample(60))
    posterior, joint = gp.posterior(points), gp.joint(points)
    basis, alpha, C = used(gp)
    k = KERNEL(basis, points)
    assert_same(posterior, Posterior(k.mT @ alpha, KERNEL.diag(points) + (k * (C @ k)).sum(0)), 1e-9)
    torch.testing.assert_close(gp.mean(points), posterior.mean)
    assert all(map(torch.equal, gp(points), posterior))
    torch.testing.assert_close(joint.mean, posterior.mean)
    covariance = KERNEL(points, points) + k.mT @ C @ k
    torch.testing.assert_close(joint.covariance_matrix, covariance, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kernel", [KERNEL, Matern(2, smoothness=2.5).requires_grad_(False)])
def test_the_posterior_is_differentiable_in_its_inputs_also_at_basis_vectors(kernel):
    gp = sparse(12, 0.3, kernel=kernel)
    gp.update(*sample(60))
    points = torch.cat([gp.basis[:2], sample(2)[0]]).requires_grad_()
    assert torch.autograd.gradcheck(lambda points: (*gp.posterior(points), gp.mean(points)), points)
