"""Pruning by information and age: the limits of the weight, bounded forms, what a process does with it."""

import pytest
import torch

from torch_gprl.gp import AgeAwareScore, BasisStatistics, InformationScore, SparseOnlineGP
from torch_gprl.kernels import SquaredExponential

FORMS = ("exponential", "logit")


def statistics(stamps: torch.Tensor, used: int | None = None) -> BasisStatistics:
    size = stamps.shape[-1]
    alpha, inverse, precision = (torch.rand(stamps.shape, dtype=torch.float64) + 0.1 for _ in range(3))
    mask = torch.arange(size).expand(stamps.shape) < (size if used is None else used)
    return BasisStatistics(alpha, inverse, lambda: precision, stamps, mask)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["mean", "kl"])
def test_weight_0_picks_the_victim_of_the_information_score(form, kind):
    seen = statistics(torch.randint(0, 50, (6, 20)))
    score = AgeAwareScore(0.0, form, base=InformationScore(kind))(seen)
    assert torch.equal(score.argsort(-1), InformationScore(kind)(seen).argsort(-1))


@pytest.mark.parametrize("form", FORMS)
def test_weight_1_is_first_in_first_out(form):
    stamps = torch.stack([torch.randperm(40) for _ in range(5)])
    assert torch.equal(AgeAwareScore(1.0, form)(statistics(stamps)).argsort(-1), stamps.argsort(-1))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("weight", [0.25, 0.9])
def test_equal_stamps_make_age_irrelevant(form, weight):
    seen = statistics(torch.full((3, 15), 7))
    score = AgeAwareScore(weight, form)(seen)
    assert torch.equal(score.argsort(-1), InformationScore()(seen).argsort(-1))


@pytest.mark.parametrize("form", FORMS)
def test_recency_stays_within_0_and_1_for_stamps_of_any_size(form):
    seen = statistics(torch.tensor([[0, 1, 999_999, 1_000_000], [0, 1, 2, 3]]))
    recency = AgeAwareScore(0.5, form).recency(seen)
    assert recency.isfinite().all()
    assert (recency >= 0).all()
    torch.testing.assert_close(recency[:, -1], torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("form", FORMS)
def test_only_differences_of_stamps_count(form):
    seen = statistics(torch.randint(0, 30, (2, 10)))
    later = seen._replace(stamps=seen.stamps + 10_000)
    score = AgeAwareScore(0.5, form)
    torch.testing.assert_close(score(seen), score(later), rtol=1e-12, atol=0)


@pytest.mark.parametrize("form", FORMS)
def test_unused_rows_change_nothing(form):
    seen = statistics(torch.randint(0, 30, (2, 10)), used=6)
    other = seen._replace(
        stamps=seen.stamps.masked_fill(~seen.mask, 10**6), alpha=seen.alpha.masked_fill(~seen.mask, 1e9)
    )
    score = AgeAwareScore(0.5, form)
    assert torch.equal(score(seen)[:, :6], score(other)[:, :6])


def test_the_timescale_is_where_the_exponential_form_has_fallen_to_1_over_e():
    recency = AgeAwareScore(1.0, timescale=5.0).recency(statistics(torch.tensor([[0, 5, 10]])))
    torch.testing.assert_close(
        recency[0], torch.exp(torch.tensor([-2.0, -1.0, 0.0], dtype=torch.float64)), rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("form", FORMS)
def test_a_process_keeps_fewer_old_vectors_the_more_age_counts(form):
    generator = torch.Generator().manual_seed(0)
    blocks = [torch.rand(40, 2, dtype=torch.float64, generator=generator) for _ in range(60)]
    ages = []
    for weight in (0.0, 0.5, 1.0):
        gp = SparseOnlineGP(SquaredExponential(2, 0.2), 40, 1e-3, pruning=AgeAwareScore(weight, form))
        for stamp, block in enumerate(blocks):
            gp.update(block, torch.sin(5 * block.sum(-1)), stamp=stamp)
        ages.append((59 - gp.stamps[gp.mask]).double().mean().item())
    assert ages[0] > ages[1] + 2
    assert ages[0] > ages[2] + 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"age_weight": -0.1}, "age_weight must lie between 0 and 1, got -0.1"),
        ({"age_weight": float("nan")}, "age_weight must lie between 0 and 1"),
        ({"age_weight": 0.5, "timescale": 0.0}, "timescale must be positive"),
    ],
)
def test_numbers_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        AgeAwareScore(**arguments)
