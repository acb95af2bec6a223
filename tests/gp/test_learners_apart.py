"""Learners in one program leave each other alone, also when only some are full or only some have data."""

import pytest
import torch

from torch_gprl.gp import SparseOnlineGP, fit_hyperparameters
from torch_gprl.kernels import SquaredExponential

F64 = torch.float64


def test_a_learner_between_budget_and_pruning_is_not_pruned_by_a_fuller_one() -> None:
    scales = torch.tensor([0.2, 0.6], dtype=F64)
    kernel = SquaredExponential(2, scales[:, None], batch_shape=(2,))
    batch = SparseOnlineGP(kernel, 40, 0.1, 0.3)
    alone = [SparseOnlineGP(SquaredExponential(2, scale), 40, 0.1, 0.3) for scale in scales.tolist()]
    for _ in range(40):
        inputs, targets = 4 * torch.rand(2, 16, 2, dtype=F64), torch.randn(2, 16, dtype=F64)
        batch.update(inputs, targets)
        for i, gp in enumerate(alone):
            gp.update(inputs[i], targets[i])
        assert batch.size.tolist() == [int(gp.size) for gp in alone]
    query = 4 * torch.rand(30, 2, dtype=F64)
    for i, gp in enumerate(alone):
        torch.testing.assert_close(
            batch.posterior(query).mean[i], gp.posterior(query).mean, rtol=0, atol=1e-8
        )
        torch.testing.assert_close(batch.evidence_constant[i], gp.evidence_constant, rtol=1e-8, atol=0)


def test_points_that_do_not_count_leave_a_full_basis_as_it_would_be_without_them() -> None:
    filled = torch.rand(200, 2, dtype=F64) * 6
    few = torch.rand(4, 2, dtype=F64) * 6
    bare, padded = (SparseOnlineGP(SquaredExponential(2, 0.5), 10, 0.01) for _ in range(2))
    for gp in (bare, padded):
        gp.update(filled, filled.sum(-1).sin())
    bare.update(few, few.sum(-1).sin())
    block = torch.cat([few, torch.full((60, 2), torch.nan, dtype=F64)])
    padded.update(block, block.sum(-1).sin(), mask=torch.arange(64) < 4)
    assert int(padded.size) == int(bare.size)
    torch.testing.assert_close(padded.posterior(filled).mean, bare.posterior(filled).mean, rtol=0, atol=1e-10)


def test_parts_that_forget_what_made_the_basis_merge_to_the_whole() -> None:
    inputs = torch.rand(300, 2, dtype=F64) * 3
    targets = inputs.sum(-1).sin()
    whole = SparseOnlineGP(SquaredExponential(2, 0.7), 30, 0.01)
    whole.update(inputs[:100], targets[:100])
    part = SparseOnlineGP(SquaredExponential(2, 0.7), 30, 0.01)
    part.load_state_dict(whole.state_dict())
    part.forget()
    for gp in (whole, part):
        gp.novelty_threshold = torch.inf  # no additions: the bases stay one
    part.update(inputs[200:], targets[200:])
    whole.update(inputs[100:200], targets[100:200])
    reference = SparseOnlineGP(SquaredExponential(2, 0.7), 30, 0.01)
    reference.load_state_dict(whole.state_dict())
    reference.novelty_threshold = torch.inf
    reference.update(inputs[200:], targets[200:])
    whole.merge(part)
    torch.testing.assert_close(
        whole.posterior(inputs).mean, reference.posterior(inputs).mean, rtol=0, atol=1e-10
    )
    torch.testing.assert_close(whole.log_marginal_likelihood(), reference.log_marginal_likelihood())
    assert int(whole.observations) == 300


def test_a_shared_kernel_cannot_be_fitted_learner_by_learner() -> None:
    gp = SparseOnlineGP(SquaredExponential(1), 10, 0.01, batch_shape=(3,))
    before = gp.kernel.lengthscale.clone()
    with pytest.raises(ValueError, match="batch_shape"):
        fit_hyperparameters(gp, torch.rand(3, 20, 1, dtype=F64), torch.rand(3, 20, dtype=F64))
    assert torch.equal(gp.kernel.lengthscale, before)


def test_another_kernel_object_is_noticed() -> None:
    inputs = torch.rand(50, 1, dtype=F64) * 5
    gp, fresh = (SparseOnlineGP(SquaredExponential(1), 30, 0.01, novelty_threshold=0) for _ in range(2))
    gp.update(inputs, inputs[:, 0].sin())
    fresh.update(inputs, inputs[:, 0].sin())
    gp.kernel = SquaredExponential(1, 1.5)
    fresh.kernel.lengthscale = 1.5
    torch.testing.assert_close(gp.posterior(inputs).mean, fresh.posterior(inputs).mean, rtol=0, atol=1e-9)


def test_evidence_of_the_stream_finds_a_kernel_that_predicts_better() -> None:
    inputs = torch.rand(400, 2, dtype=F64) * 4
    targets = inputs.sum(-1).sin() + 0.1 * torch.randn(400, dtype=F64)
    gp = SparseOnlineGP(SquaredExponential(2, 0.3), 60, 0.01)
    gp.update(inputs[:300], targets[:300])
    before = gp.log_marginal_likelihood().item()
    error = (gp.posterior(inputs[300:]).mean - targets[300:]).square().mean()
    assert bool(fit_hyperparameters(gp, inputs[300:], targets[300:], evidence="stream"))
    assert gp.log_marginal_likelihood().item() > before
    assert bool((gp.kernel.lengthscale > 0.6).all())  # the function varies over a length of about 1.4
    assert (gp.posterior(inputs[300:]).mean - targets[300:]).square().mean() < error


@pytest.mark.parametrize("length", [1, 7, 32, 256])
def test_a_full_basis_admits_as_many_points_however_the_stream_is_cut(length: int) -> None:
    gp = SparseOnlineGP(SquaredExponential(3, 0.2), 20, 1e-3, overshoot=80)
    gp.update(5 * torch.rand(64, 3, dtype=F64), torch.randn(64, dtype=F64))  # all novel
    before = int(gp.size)
    assert before == 20 + 64 // 8
    for block in (5 * torch.rand(592, 3, dtype=F64)).split(length):
        gp.update(block, torch.randn(len(block), dtype=F64))
    assert int(gp.observations) == 656
    assert int(gp.size) == before + (400 - 64) // 8 + 256 // 32  # young up to 20 points a basis vector
