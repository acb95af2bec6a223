"""What a deletion leaves behind, and which basis vectors go."""

from typing import Literal

import jaxtyping
import pytest
import torch
from torch import Tensor

from torch_gprl.gp import BasisStatistics, InformationScore, RecursiveGP, SparseOnlineGP
from torch_gprl.gp.pruning import Whitened, basis_statistics, keep_first
from torch_gprl.kernels import SquaredExponential

NOISE = 0.2
KEPT, ALL = 9, 12
KERNEL = SquaredExponential(2, [0.8, 1.2], 1.5).requires_grad_(False)


def sample(*shape: int) -> tuple[Tensor, Tensor]:
    inputs = torch.randn(*shape, 2, dtype=torch.float64)
    return inputs, inputs.sin().sum(-1) + NOISE**0.5 * torch.randn(shape, dtype=torch.float64)


def learned(*batch: int) -> SparseOnlineGP:
    """Processes of 12 basis vectors, buffers full to the last row, that have projected 60 points more."""
    gp = SparseOnlineGP(KERNEL, ALL - 1, NOISE, 0.0, batch, overshoot=1).requires_grad_(False)
    gp.budget = ALL  # no pruning
    gp.update(*sample(*batch, ALL))
    gp.novelty_threshold = 1e12
    gp.update(*sample(*batch, 60))
    return gp


def state(gp: SparseOnlineGP) -> Whitened:
    return Whitened(gp.gram_factor, gp.precision, gp.information)


def seen_by_a_score(gp: SparseOnlineGP) -> BasisStatistics:
    gp.refresh()
    rows = int(gp.size)
    used = Whitened(gp.gram_factor[:rows, :rows], gp.precision[:rows, :rows], gp.information[:rows])
    return basis_statistics(used, gp.stamps[:rows], gp.mask[:rows])


def values(whitened: Whitened) -> tuple[Tensor, Tensor]:
    """Mean and covariance of the basis values u = L w, w ~ N(A⁻¹b, A⁻¹)."""
    inverse = torch.linalg.inv(whitened.precision)
    mean = whitened.gram_factor @ inverse @ whitened.information.unsqueeze(-1)
    return mean.squeeze(-1), whitened.gram_factor @ inverse @ whitened.gram_factor.mT


def log_evidence(whitened: Whitened) -> Tensor:
    """½ bᵀA⁻¹b − ½ log|A|: the evidence up to the constant of the data."""
    solved = torch.linalg.solve(whitened.precision, whitened.information.unsqueeze(-1)).squeeze(-1)
    return 0.5 * ((whitened.information * solved).sum(-1) - torch.logdet(whitened.precision))


def statistics(gp: RecursiveGP) -> BasisStatistics:
    """The same quantities from the recursion's explicit matrices."""
    precision = gp.gram_inverse.diagonal()
    stamps = torch.zeros(gp.size, dtype=torch.long)
    return BasisStatistics(gp.alpha, precision, lambda: precision + gp.C.diagonal(), stamps, stamps == 0)


def test_a_marginal_deletion_leaves_the_values_that_stay_as_they_were():
    gp = learned(3)
    order = torch.stack([torch.randperm(ALL) for _ in range(3)])
    left, _ = keep_first(state(gp), order, KEPT, "moment")
    mean, covariance = values(state(gp))
    new_mean, new_covariance = values(left)
    for learner in range(3):
        kept = order[learner, :KEPT]
        torch.testing.assert_close(new_mean[learner], mean[learner, kept])
        torch.testing.assert_close(new_covariance[learner], covariance[learner][kept][:, kept])


def test_a_conditioning_deletion_fixes_what_goes_at_its_prior_mean_given_what_stays():
    gp = learned()
    order = torch.randperm(ALL)
    left, _ = keep_first(state(gp), order, KEPT, "dtc")
    kept, gone = order[:KEPT], order[KEPT:]
    # the observed quantity is the residual r = u_gone − K_gk K_kk⁻¹ u_kept, exactly zero
    K = KERNEL(gp.basis, gp.basis)
    H = torch.zeros(ALL - KEPT, ALL, dtype=torch.float64)
    H[:, gone] = torch.eye(ALL - KEPT, dtype=torch.float64)
    H[:, kept] = -torch.linalg.solve(K[kept][:, kept], K[kept][:, gone]).mT
    mean, covariance = values(state(gp))
    gain = covariance @ H.mT @ torch.linalg.inv(H @ covariance @ H.mT)
    new_mean, new_covariance = values(left)
    torch.testing.assert_close(new_mean, (mean - gain @ H @ mean)[kept], rtol=1e-7, atol=1e-7)
    expected = (covariance - gain @ H @ covariance)[kept][:, kept]
    torch.testing.assert_close(new_covariance, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("projection", ["moment", "dtc"])
def test_the_kept_vectors_have_the_cholesky_factor_of_their_own_gram_matrix(projection):
    gp = learned(3)
    order = torch.stack([torch.randperm(ALL) for _ in range(3)])
    left, _ = keep_first(state(gp), order, KEPT, projection)
    for learner in range(3):
        basis = gp.basis[learner, order[learner, :KEPT]]
        expected = torch.linalg.cholesky(KERNEL(basis, basis))
        torch.testing.assert_close(left.gram_factor[learner], expected, rtol=1e-9, atol=1e-9)


def test_a_marginal_deletion_leaves_the_evidence_as_it_was():
    gp = learned(3)
    order = torch.stack([torch.randperm(ALL) for _ in range(3)])
    left, change = keep_first(state(gp), order, KEPT, "moment")
    torch.testing.assert_close(log_evidence(left) + change, log_evidence(state(gp)))


@pytest.mark.parametrize("projection", ["moment", "dtc"])
def test_one_round_deletes_what_several_would(projection):
    gp, order = learned(), torch.randperm(ALL)
    at_once, change = keep_first(state(gp), order, KEPT, projection)
    singly, total = keep_first(state(gp), order, ALL - 1, projection)
    for kept in range(ALL - 2, KEPT - 1, -1):
        singly, one = keep_first(singly, torch.arange(kept + 1), kept, projection)
        total = total + one
    for mine, theirs in zip((*singly, total), (*at_once, change), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("projection", ["moment", "dtc"])
def test_keeping_everything_only_reorders(projection: Literal["moment", "dtc"]):
    gp, order = learned(), torch.randperm(ALL)
    left, change = keep_first(state(gp), order, ALL, projection)
    (mean, covariance), (new_mean, new_covariance) = values(state(gp)), values(left)
    torch.testing.assert_close(new_mean, mean[order])
    torch.testing.assert_close(new_covariance, covariance[order][:, order])
    assert not change.any()


@pytest.mark.parametrize("kind", ["mean", "kl"])
def test_scores_and_statistics_are_those_of_the_recursion(kind):
    inputs, targets = sample(70)
    twin = RecursiveGP(KERNEL, 100, NOISE, 0.3, score=kind)
    gp = SparseOnlineGP(KERNEL, 100, NOISE, 0.3, order="arrival").requires_grad_(False)
    for process in (twin, gp):
        process.update(inputs, targets)
    assert gp.size == twin.size < 70
    ours = seen_by_a_score(gp)
    (*seen, precision), (*expected, precision_there) = ours[:3], statistics(twin)[:3]
    for mine, theirs in zip((*seen, precision()), (*expected, precision_there()), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-7)
    assert ours.mask.all()
    torch.testing.assert_close(InformationScore(kind)(ours), twin.scores(), rtol=1e-6, atol=1e-9)


def test_the_mean_score_is_the_squared_change_of_the_mean_at_the_vector_that_goes():
    gp = learned()
    score = InformationScore("mean")(seen_by_a_score(gp))
    for victim in range(ALL):
        order = torch.cat([torch.arange(ALL)[torch.arange(ALL) != victim], torch.tensor([victim])])
        left, _ = keep_first(state(gp), order, ALL - 1, "moment")
        basis, where = gp.basis[order[:-1]], gp.basis[victim : victim + 1]
        after = KERNEL(where, basis) @ torch.linalg.solve(KERNEL(basis, basis), values(left)[0])
        change = (after - gp.posterior(where).mean).square().squeeze()
        torch.testing.assert_close(change, score[victim], rtol=1e-6, atol=1e-12)


def test_the_kl_score_is_the_squared_signal_to_noise_ratio_of_a_coefficient():
    # f = Σ_i c_i k(·, x_i) on the basis, c = K⁻¹u: the score is E[c_i]²/var[c_i]
    gp = learned()
    mean, covariance = values(state(gp))
    inverse = torch.linalg.inv(KERNEL(gp.basis, gp.basis))
    expected = (inverse @ mean).square() / (inverse @ covariance @ inverse).diagonal()
    torch.testing.assert_close(InformationScore("kl")(seen_by_a_score(gp)), expected, rtol=1e-6, atol=1e-9)


def test_an_unknown_score_is_refused(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match="'mean' or 'kl', got 'entropy'"):
        InformationScore("entropy")  # type: ignore[arg-type]


def test_the_lowest_scores_go_and_stamps_stay_with_their_vectors():
    worth = torch.randperm(ALL + 1).double()

    def by_stamp(statistics: BasisStatistics) -> Tensor:
        return worth[statistics.stamps]

    inputs, targets = sample(ALL + 1)
    gp = SparseOnlineGP(KERNEL, 8, NOISE, 0.0, overshoot=5, pruning=by_stamp, order="arrival")
    for stamp in range(ALL + 1):
        assert gp.size == stamp
        gp.update(inputs[stamp : stamp + 1], targets[stamp : stamp + 1], stamp=stamp)
    kept = worth.topk(8).indices.sort().values
    assert gp.size == 8
    assert torch.equal(gp.basis[:8], inputs[kept])
    assert torch.equal(gp.stamps[:8], kept)
    assert not gp.basis[8:].any()


@pytest.mark.parametrize("target", [-3.0, 0.0, 2.0])
def test_each_target_adds_its_log_predictive_density_to_the_evidence_also_when_it_prunes(target):
    gp = SparseOnlineGP(KERNEL, 6, NOISE, 0.0, overshoot=1, order="arrival").requires_grad_(False)
    gp.update(*sample(30))
    new, before = sample(1)[0], gp.log_marginal_likelihood()
    prediction = gp.posterior(new).predictive(NOISE)
    value = torch.tensor([target], dtype=torch.float64)
    expected = torch.distributions.Normal(prediction.mean, prediction.stddev).log_prob(value)
    basis = gp.basis.clone()
    gp.update(new, value)
    assert gp.size == 6
    assert not torch.equal(gp.basis, basis)  # the new point joined, another went
    torch.testing.assert_close(
        gp.log_marginal_likelihood() - before, expected.squeeze(), rtol=1e-8, atol=1e-8
    )
