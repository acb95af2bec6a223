"""The comparison is fair: the same starts for all, sustained crossings, and no work done twice."""

import io
import json

import gymnasium
import numpy as np
import pytest
import torch
from rich.console import Console
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from benchmarks import sample_efficiency, sample_report
from benchmarks.sample_arms import ARMS, GOALS, Arm, Goal
from benchmarks.sample_efficiency import FixedStarts, Options
from torch_gprl.runs import evaluate


class Zero(TensorDictModuleBase):
    """Does nothing."""

    in_keys, out_keys = ["observation"], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict.get("observation")
        return tensordict.set("action", torch.zeros_like(observation[..., :1]))


def test_evaluations_start_where_gymnasium_seeds_start_for_every_learner_and_every_time():
    starts = FixedStarts("Pendulum-v1", learners=2, episodes=3)
    env = gymnasium.make("Pendulum-v1")
    expected = torch.tensor(np.stack([env.reset(seed=1000 + seed)[0] for seed in range(3)]))
    for _ in range(2):
        observation = starts.reset()["observation"]
        torch.testing.assert_close(observation, expected.expand(2, -1, -1))
    first, again = evaluate(starts, Zero()), evaluate(starts, Zero())
    assert torch.equal(first, again)
    assert torch.equal(first[0], first[1])


@pytest.mark.parametrize(
    ("returns", "first"),
    [([0, 1, 1, 1, 0], 1), ([1, 1, 0, 1, 1], None), ([1, 0, 1, 1, 1], 2), ([1, 1], None), ([1, 1, 1], 0)],
)
def test_a_crossing_is_sustained_over_three_evaluations(returns, first):
    assert sample_report.crossing(np.array(returns, dtype=float), 1.0) == first


def record(returns: list[list[float]]) -> dict:
    frames = [100 * (number + 1) for number in range(len(returns))]
    seconds = [0.5 * frame for frame in frames]
    machine = {"date": "today", "processor": "one"}
    return {
        "task": "pendulum-explore",
        "arm": "ours",
        "frames": frames,
        "cpu_seconds": seconds,
        "returns": returns,
        "machine": machine,
    }


def test_rows_hold_median_worst_and_relapses():
    # the first seed crosses at 200 and relapses in one of four, the second at 300, the third never
    returns = [[0, 0, 0], [9, 0, 9], [9, 9, 9], [9, 9, 0], [0, 9, 0]]
    goals = {"pendulum-explore": Goal((5.0,), 500, 100, {})}
    (row,) = sample_report.summarise([record(returns)], goals)
    assert row["median_frames"] == 300
    assert row["worst_frames"] is None
    assert row["median_cpu_seconds"] == 150.0
    assert (row["solved"], row["seeds"], row["relapsed"]) == (2, 3, 1)
    assert row["mean_relapses"] == pytest.approx(0.125)


def test_a_finished_record_is_not_made_again(tmp_path, monkeypatch):
    calls = []

    def train(task, seeds, frames, every):
        calls.append((task, list(seeds), frames))
        for seen in range(every, frames + 1, every):
            yield seen, Zero()

    monkeypatch.setitem(ARMS, "still", Arm(train, side_by_side=2))
    monkeypatch.setitem(GOALS, "pendulum-explore", Goal((50.0,), 40, 10, {}))
    options = Options(tasks=("pendulum-explore",), arms=("still",), seeds=3, episodes=2, out=tmp_path)
    for _ in range(2):
        sample_efficiency.main(options)
    assert calls == [("pendulum-explore", [0, 1], 40), ("pendulum-explore", [2], 40)]
    (row,) = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert (row["seeds"], row["solved"], row["worst_frames"]) == (3, 0, None)
    assert (tmp_path / "learning_curves.png").stat().st_size > 10_000
    text = io.StringIO()
    sample_report.print_table([row], Console(file=text, width=140))
    assert "never in 40" in text.getvalue()


def test_our_learner_is_shown_every_so_many_steps():
    shown = [frames for frames, _ in ARMS["q-learning"].train("pendulum-balance", range(3, 5), 100, 50)]
    assert shown == [50, 100]


def test_an_unknown_name_is_refused_with_what_there_is(tmp_path):
    with pytest.raises(ValueError, match="unknown task 'Pendulum-v0'; choose from Pendulum-v1"):
        sample_efficiency.main(Options(tasks=("Pendulum-v0",), out=tmp_path))
    with pytest.raises(ValueError, match="unknown arm 'TD3'; choose from q-learning"):
        sample_efficiency.main(Options(arms=("TD3",), out=tmp_path))
