"""Processes side by side: what is taught alike knows alike, and nobody disturbs the one that guides."""

import json

import numpy as np
import pytest
import torch

import envs
from experiments import action_values
from experiments.action_values import ANEW, Options, error, main, played
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig

REMEMBERED = "all experience kept, solved anew"
SMALL = {"rollout_steps": 20, "targets": "differences", "budget": 15, "renew_every": 1}


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(action_values, "STEPS", 10)
    monkeypatch.setattr(action_values, "TAIL", 5)


def test_processes_that_are_taught_alike_know_alike_and_others_do_not(tmp_path, monkeypatch):
    ways = {ANEW: SMALL, "the same": SMALL, REMEMBERED: SMALL | {"replay": 100, "noise": 0.1}}
    monkeypatch.setattr(action_values, "WAYS", ways)
    monkeypatch.setattr(action_values, "SIDE_BY_SIDE", 1)
    folders = {"out": tmp_path / "out", "results": tmp_path / "results"}
    main(Options(task="pendulum-balance", learners=2, num_envs=2, frames=120, **folders))
    pieces = [json.loads(path.read_text()) for path in sorted(folders["out"].iterdir())]
    errors = {way: np.concatenate([piece[way] for piece in pieces], 1) for way in ways}
    assert errors[ANEW].shape == (3, 2)
    assert (errors[ANEW][:, 0] != errors[ANEW][:, 1]).all()  # learners of two programs differ
    np.testing.assert_array_equal(errors["the same"], errors[ANEW])
    assert (errors[REMEMBERED] != errors[ANEW]).all()
    (result,) = folders["results"].iterdir()
    figures = json.loads(result.read_text())
    assert figures["the same"]["below estimated anew"] == [0.0, 0.0, 0.0]
    below = errors[ANEW][1:].mean() - errors[REMEMBERED][1:].mean()
    assert figures[REMEMBERED]["below estimated anew"][0] == pytest.approx(below)


def test_the_error_of_an_empty_process_is_the_root_mean_square_return():
    env = envs.make("pendulum-swingup", learners=2, num_envs=3, seed=1, threads=1, horizon=16)
    learner = PolicyGradient(env, PolicyGradientConfig(**SMALL))
    before = learner.policy.noise.state()["generators"]
    episodes = played(env, learner)
    torch.testing.assert_close(learner.policy.noise.state()["generators"], before, rtol=0, atol=0)
    reward = episodes["next", "reward"].squeeze(-1).double()
    ahead = 0.9 ** torch.arange(15).double()
    returns = torch.stack([(reward[..., t:] * ahead[: 15 - t]).sum(-1) for t in range(10)], -1)
    expected = returns.square().mean((1, 2)).sqrt()
    torch.testing.assert_close(error(learner.critic, episodes, 0.9), expected)
