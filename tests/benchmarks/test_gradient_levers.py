"""What the levers' table says of known returns; that the preset solves its task from batches of 200 steps."""

import json

import pytest

from benchmarks import gradient_levers
from benchmarks.gradient_levers import Options, draw, main, read, row, run

FRAMES = [200, 400, 600, 800, 1000]


def record(*learners: list[float]) -> dict:
    returns = [list(batch) for batch in zip(*learners, strict=True)]
    return {"lever": "as preset", "frames": FRAMES, "returns": returns, "cpu_seconds": [1.0] * len(FRAMES)}


def test_a_row_counts_steps_to_a_lasting_success_and_relapses_after_it():
    solved = [-900.0, -150.0, -150.0, -150.0, -150.0]
    relapsed = [-150.0, -150.0, -150.0, -500.0, -150.0]
    lucky = [-150.0, -900.0, -150.0, -900.0, -150.0]
    text = row(record(solved, relapsed, lucky))
    # 400 and 200 steps; one of the second's five evaluations is a relapse
    assert text == "| as preset | 1,000 | 2 of 3 | 400 | never | 10% | -150 | -150 |"


def test_records_of_the_same_lever_are_read_as_one(tmp_path):
    for first, value in ((0, -100.0), (5, -300.0)):
        (tmp_path / f"{first}.json").write_text(json.dumps(record([value] * 5)))
    (joined,) = read(tmp_path)
    assert joined["returns"] == [[-100.0, -300.0]] * 5
    assert len(draw([joined]).axes) == 2


def test_a_lever_runs_in_batches_of_200_steps_or_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(gradient_levers, "evaluate", lambda starts, policy: starts.starts[0][:, :, 0] - 1e3)
    made = run("one step of the policy per batch", 0, Options(frames=200, learners=2, episodes=2))
    assert made["frames"] == [200]
    assert len(made["returns"][0]) == 2
    with pytest.raises(SystemExit, match="unknown lever 'luck'; choose from as preset"):
        main(Options(levers=("luck",), out=tmp_path))


@pytest.mark.slow
def test_the_preset_solves_the_pendulum_within_three_thousand_steps():
    made = run("as preset", 0, Options(frames=3_000, episodes=20))
    solved, learners = row(made).split("|")[3].split(" of ")
    assert int(solved) >= int(learners) - 1 >= 4
