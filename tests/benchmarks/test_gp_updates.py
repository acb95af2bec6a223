"""The comparison is fair: peers compute what they should, streams are what they say, and timing adds up."""

import io
import json

import pytest
import torch
from rich.console import Console

from benchmarks import gp_peers, gp_report, gp_updates
from benchmarks.gp_peers import OURS, PEERS, WINDOWS, accuracy
from benchmarks.streams import STREAMS, TEST_POINTS, novel, pendulum, uniform
from benchmarks.timing import exponent, matrix_product, rates
from torch_gprl.gp import ExactGP

TINY = gp_updates.Effort(
    turn=0.0,
    rounds=1,
    points=200,
    common=64,
    seeds=1,
    patience=60.0,
    budgets=(10, 40),
    blocks=(1, 32),
    dims=(3, 8),
    learners=(1, 2),
    settled=((40, 32),),
)


def fed(peer, stream, budget, points=192):
    """The peer after blocks of 32 from the stream."""
    model = PEERS[peer](stream, budget)
    for start in range(0, points, 32):
        model.update(stream.inputs[start : start + 32], stream.targets[start : start + 32])
    return model


@pytest.mark.parametrize("peer", PEERS)
def test_within_its_budget_every_peer_is_the_dense_process(peer, monkeypatch):
    monkeypatch.setattr(gp_peers, "NOVELTY_THRESHOLD", 0.0)  # nothing is left out
    stream = novel(200)
    exact = ExactGP(stream.kernel, stream.noise_variance).requires_grad_(False)
    dense = exact.fit(stream.inputs[:192], stream.targets[:192]).posterior(stream.test_inputs)
    for mine, expected in zip(fed(peer, stream, 250).predict(stream.test_inputs), dense, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("peer", WINDOWS)
def test_a_window_keeps_the_newest_points_within_the_budget(peer):
    stream = novel(200)
    window = fed(peer, stream, budget=64, points=96)
    latent = window.predict(torch.cat([stream.inputs[80:96], stream.inputs[:16]]))[1]
    assert latent[:16].max() < stream.noise_variance < latent[16:].min()


def test_the_recursion_in_place_is_the_textbook_recursion_also_when_it_prunes():
    stream = pendulum(400)
    fast, plain = (
        fed(peer, stream, budget=20, points=384) for peer in ("recursion in place", "textbook recursion")
    )
    assert fast.size == 20
    for one, other in zip(fast.predict(stream.test_inputs), plain.predict(stream.test_inputs), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", STREAMS)
def test_a_stream_is_standardised_finite_and_the_same_every_time(name):
    stream, again = (STREAMS[name](500) for _ in range(2))
    assert torch.equal(stream.inputs, again.inputs)
    assert torch.equal(stream.targets, again.targets)
    assert len(stream.inputs) == len(stream.targets) == 500
    assert len(stream.test_inputs) == len(stream.test_targets) == TEST_POINTS
    for parts in ((stream.inputs, stream.test_inputs), (stream.targets, stream.test_targets)):
        data = torch.cat(parts)
        assert data.isfinite().all()
        torch.testing.assert_close(data.mean(0), torch.zeros_like(data[0]), rtol=0, atol=1e-9)
        torch.testing.assert_close(data.std(0), torch.ones_like(data[0]))


def test_streams_are_as_novel_as_their_names_say():
    sizes = {
        name: int(fed(OURS, make(600), budget=600, points=576).gp.size) for name, make in STREAMS.items()
    }
    assert sizes["every point novel"] > 500
    assert sizes["settled"] < 60
    assert sizes["near duplicates"] <= 300


def test_the_stream_of_any_dimension_has_that_many():
    assert uniform(50, 23).inputs.shape == (50, 23)


def test_accuracy_is_that_of_the_noise_where_everything_is_known():
    stream = STREAMS["settled"](2000)
    rmse, nlpd = accuracy(fed(OURS, stream, budget=100, points=1984), stream)
    assert 0.25 < rmse < 0.32  # noise of 0.3 standard deviations
    assert 0.1 < nlpd < 0.3  # log(0.3) + ½ log 2πe = 0.21


def test_rates_are_medians_of_rounds_in_which_all_take_turns():
    now, turns = [0.0], []
    pace = iter([1.0, 2.0, 4.0, 2.0, 10.0, 2.0])

    def turn(name, units):
        def work() -> int:
            turns.append(name)
            now[0] += next(pace)
            return units

        return work

    speed = rates({"a": turn("a", 8), "b": turn("b", 1)}, 3, 0.5, clock=lambda: now[0])
    assert turns == ["a", "b"] * 3
    assert speed == {"a": 2.0, "b": 0.5}


def test_the_exponent_of_a_power_law_is_its_power():
    assert exponent([1, 10, 200], [3 * value**1.7 for value in (1, 10, 200)]) == pytest.approx(1.7)


def test_a_matrix_product_counts_two_operations_for_each_of_size_cubed():
    assert matrix_product(64)() == 2 * 64**3


def test_learners_start_at_places_of_their_own():
    stream = pendulum(200)
    data = gp_updates.staggered(stream, 4)
    assert data.inputs.shape == (4, 200, 3)
    assert torch.equal(data.inputs[1, 0], stream.inputs[50])
    assert torch.equal(data.targets[3, :50], stream.targets[150:])


def test_a_whole_run_prints_every_table_and_writes_json_and_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(gp_updates, "BUDGET", 40)
    monkeypatch.setattr(gp_updates, "LEARNER_BUDGET", 10)
    printed = io.StringIO()
    monkeypatch.setattr(gp_updates, "Console", lambda stderr=False: Console(file=printed, width=120))
    gp_updates.main(gp_updates.Options(out=tmp_path / "results" / "gp.json"), TINY)
    results = json.loads((tmp_path / "results" / "gp.json").read_text())
    assert (tmp_path / "results" / "gp.png").stat().st_size > 10_000
    assert results["machine"]["threads"] == 1
    assert len(results["streams"]) == len(STREAMS) * len(PEERS)
    assert {row["peer"] for row in results["block"]} == set(PEERS)
    errors = {(row["peer"], row["points"]): row["rmse"] for row in results["accuracy"]}
    assert errors[OURS, 200] < errors[OURS, 64] < 2
    assert all(0 < row["fraction"] < 2 for row in results["settled"])
    assert set(results["exponents"]) == set(gp_report.VARIABLES)
    for heading in ("Budget 40", "held-out", "matrix product", "over all learners", "Mean and variance"):
        assert heading in printed.getvalue()
