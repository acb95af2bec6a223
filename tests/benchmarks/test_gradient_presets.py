"""That the presets' arms differ in their memory alone, and what the table says of known returns."""

import json

from benchmarks import gradient_presets
from benchmarks.gradient_presets import FRESH, REMEMBERED, Options, main, row


def test_arms_differ_in_memory_alone_and_are_not_run_twice(tmp_path, monkeypatch, capsys):
    configs = []
    made = gradient_presets.PolicyGradient
    monkeypatch.setattr(
        gradient_presets, "PolicyGradient", lambda env, config: (configs.append(config), made(env, config))[1]
    )
    monkeypatch.setattr(gradient_presets, "evaluate", lambda starts, policy: starts.starts[0][:, :, 0])
    preset = {**gradient_presets.ALL_EXPERIENCE, "budget": 20, "rollout_steps": 12, "discount": 0.99}
    monkeypatch.setitem(gradient_presets.ALL_EXPERIENCE, "budget", 20)
    monkeypatch.setitem(gradient_presets.POLICY_GRADIENT_PRESETS, "cartpole-balance", preset)
    options = Options(tasks=("cartpole-balance",), learners=2, episodes=3, frames=5, out=tmp_path / "a.json")
    main(options)
    main(options)
    remembered, fresh = configs
    assert remembered.replay > 0 == fresh.replay
    for config in configs:
        assert (config.rollout_steps, config.discount) == (12, 0.99)
    records = json.loads(options.out.read_text())
    assert [record["arm"] for record in records] == [REMEMBERED, FRESH]
    assert capsys.readouterr().out.count("| cartpole-balance |") == 4


def test_a_row_shows_a_third_of_the_way_and_the_end():
    returns = [[float(step)] * 2 for step in range(1, 7)]
    record = {
        "task": "t",
        "arm": "a",
        "frames": [100, 200, 300, 400, 500, 600],
        "returns": returns,
        "cpu_seconds": 3,
    }
    assert row(record) == "| t | a | 2 | 3.0 | 200 | 2 [2, 2] | 600 | 6 [6, 6] |"
