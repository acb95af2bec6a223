"""The ablation changes one number a row, and does no row twice."""

import json
from dataclasses import replace

import pytest

from experiments import ablation
from torch_gprl.learners import DynamicProgrammingConfig


def test_every_row_changes_a_number_of_the_default_but_the_first():
    plain = DynamicProgrammingConfig()
    changed = [replace(plain, **numbers) for numbers in ablation.ROWS.values()]
    assert changed[0] == plain
    assert len(set(changed)) == len(changed)


def test_a_rerun_keeps_the_rows_that_are_there(tmp_path, monkeypatch):
    done = []

    def run(task, row, options):
        done.append(row)
        figures = {
            "frames": [100, 200, 300],
            "cpu_seconds": [1.0, 2.0, 3.0],
            "returns": [[60.0], [60.0], [0.0]],
        }
        return {"task": task, "arm": row, "seeds": [0], **figures}

    monkeypatch.setattr(ablation, "run", run)
    options = ablation.Options(
        tasks=("pendulum-explore",), rows=("all parts", "the plan alone"), out=tmp_path / "a.json"
    )
    ablation.main(replace(options, rows=("all parts",)))
    ablation.main(options)
    assert done == ["all parts", "the plan alone"]
    rows = json.loads(options.out.read_text(encoding="utf-8"))["rows"]
    assert [row["arm"] for row in rows] == done


def test_unknown_rows_are_refused_with_what_there_is(tmp_path):
    with pytest.raises(ValueError, match="unknown row 'half a hand'; choose from all parts"):
        ablation.main(ablation.Options(rows=("half a hand",), out=tmp_path / "a.json"))
