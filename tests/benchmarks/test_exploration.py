"""The comparison of ways to explore: what it measures, that arms are paired, and that it resumes."""

import json
import math
from pathlib import Path

import pytest
import torch

from benchmarks import exploration
from benchmarks.exploration import Options, main, summarise
from benchmarks.exploration_arms import (
    BY_PLANS,
    BY_VALUES,
    CELLS,
    Outcome,
    first_step,
    run,
    steps_to,
)

SETTING = BY_VALUES["pendulum-explore"]


def outcome(states: torch.Tensor, reward: torch.Tensor) -> Outcome:
    learners = len(states)
    return Outcome([100], torch.zeros(learners, 1), states, torch.full((learners, 8), 0.3), reward)


def test_the_threshold_counts_from_the_first_of_two_evaluations_in_a_row():
    returns = torch.tensor([[0.0, 60, 60, 0], [60, 0, 60, 60], [60, 0, 60, 0], [0, 0, 0, 60]])
    steps = steps_to([100, 200, 300, 400], returns, SETTING)
    assert steps.tolist() == [200, 300, 500, 500]


def test_discovery_is_the_first_time():
    happened = torch.tensor([[False, True, True], [False, False, False]])
    assert first_step(happened).tolist() == [1, 3]


def test_coverage_counts_cells():
    evenly = torch.arange(CELLS) / CELLS + 0.01
    grid = torch.cartesian_prod(evenly, evenly)
    states = torch.stack([grid, torch.full_like(grid, 0.5)])
    reward = torch.zeros(2, len(grid))
    reward[0, : len(grid) // 4] = 1.0
    measured = outcome(states, reward).measures(SETTING)
    assert measured["entropy of cells"][0] == pytest.approx(math.log(CELLS**2))
    assert measured["entropy of cells"][1] == 0
    assert measured["new cells per 1,000 steps"].tolist() == [1000, 1000 / CELLS**2]
    assert measured["time in goal"].tolist() == [0.25, 0]
    assert measured["mean sigma"].tolist() == pytest.approx([0.3, 0.3])


def test_pairs_that_agree_prove_nothing_and_pairs_that_all_differ_do():
    base = {"x": torch.linspace(0, 1, 20, dtype=torch.float64)}
    assert summarise(base, base)["x"]["p"] == 1
    better = {"x": base["x"] + torch.linspace(0.1, 0.2, 20, dtype=torch.float64)}
    assert summarise(better, base)["x"]["p"] < 1e-5


@pytest.mark.parametrize("task", ["atwood", pytest.param("MountainCarContinuous-v0", marks=pytest.mark.slow)])
def test_every_task_has_its_plane(task):
    ((_, found),) = run(BY_VALUES[task], {}, range(2), 25)
    assert found.frames == [25]
    assert found.returns.shape == (2, 1)
    assert ((found.states >= 0) & (found.states < 1)).all()
    assert found.states.shape == (2, 25, 2)


def test_rounded_rewards_are_multiples_of_their_resolution():
    ((_, found),) = run(BY_PLANS["pendulum-explore-rounded"], {}, range(2), 25)
    assert torch.equal(found.reward, torch.zeros(2, 25))  # it hangs, where the task pays about 1e-9


@pytest.mark.parametrize(("setting", "other"), [(SETTING, "upper"), (BY_PLANS["pendulum-explore"], "gibbs")])
def test_arms_start_alike(setting, other):
    first, second = (
        next(run(setting, {"exploration": scheme}, range(2), 25))[1] for scheme in ("gaussian", other)
    )
    assert torch.equal(first.states[:, 0], second.states[:, 0])


@pytest.mark.slow
def test_finished_arms_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(exploration, "QUICK_SHARE", 60)
    arms = ("gaussian 0.3", "confidence", "matched")
    options = Options("q-learning", ("pendulum-explore",), arms, quick=True, out=tmp_path)
    main(options)
    results = tmp_path / "quick" / "exploration.json"
    first = json.loads(results.read_text(encoding="utf-8"))["q-learning"]["pendulum-explore"]
    assert first["tuned"] == "gaussian 0.3"
    assert set(first["arms"]) == set(arms)
    assert (tmp_path / "quick" / "q-learning-pendulum-explore-visits.png").exists()
    monkeypatch.setattr(exploration, "run", None)  # nothing is left to run
    main(options)
    assert json.loads(results.read_text(encoding="utf-8"))["q-learning"]["pendulum-explore"] == first


def test_matched_noise_is_as_large_once_it_is_clipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    realised = {"gaussian 0.3": 0.2, "gaussian 1.0": 0.6}
    monkeypatch.setattr(exploration, "realised_sigma", lambda setting, arm, out: realised.get(arm))
    for sigma, std in ((0.1, 0.15), (0.2, 0.3), (0.4, 0.65), (0.6, 1.0)):
        assert exploration.matching_std(SETTING, sigma, tmp_path) == pytest.approx(std)
    realised.clear()
    assert exploration.matching_std(SETTING, 0.4, tmp_path) == 0.4


def test_an_arm_that_does_not_exist_is_named():
    with pytest.raises(SystemExit, match="unknown task or arm: luck; choose from"):
        main(Options(arms=("luck",)))
