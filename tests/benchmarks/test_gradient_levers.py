"""What the levers' table says of known returns; that the preset solves its task from batches of 200 steps."""

import json
import time

import pytest

from benchmarks import gradient_levers
from benchmarks.gradient_levers import Options, draw, main, read, row, run

FRAMES = [200, 400, 600, 800, 1000]


def record(*learners: list[float]) -> dict:
    returns = [list(batch) for batch in zip(*learners, strict=True)]
    return {"lever": "as preset", "frames": FRAMES, "returns": returns, "cpu_seconds": 1.0}


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


def test_a_run_that_was_stopped_goes_on_to_the_same_record(tmp_path, monkeypatch):
    monkeypatch.setattr(gradient_levers, "evaluate", lambda starts, policy: starts.starts[0][:, :, 0] - 1e3)
    monkeypatch.setitem(gradient_levers.LEVERS, "small", {"budget": 20, "improvements": 1})
    records = []
    for minutes in (600.0, 0.0):
        options = Options(frames=400, learners=2, episodes=2)
        path = tmp_path / f"{minutes}.json"
        for _ in range(2 if minutes == 0 else 1):
            run("small", 0, options, path, time.monotonic() + 60 * minutes)
        records.append(json.loads(path.read_text()) | {"cpu_seconds": 0.0})
    assert records[0] == records[1]
    assert records[0]["frames"] == [200, 400]
    assert [path.suffix for path in tmp_path.iterdir()] == [".json"] * 2


def test_a_lever_is_refused_by_name(tmp_path):
    with pytest.raises(SystemExit, match="unknown lever 'luck'; choose from as preset"):
        main(Options(levers=("luck",), out=tmp_path))


@pytest.mark.slow
def test_the_preset_solves_the_pendulum_within_three_thousand_steps(tmp_path):
    main(Options(levers=("as preset",), frames=3_000, learners=5, episodes=20, out=tmp_path))
    solved, learners = (tmp_path / "table.md").read_text().splitlines()[2].split("|")[3].split(" of ")
    assert int(solved) == int(learners) == 5
