"""What holds for every member of `envs.ALL`."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import envs
from envs import gym

EVERY_TASK = pytest.mark.parametrize("task", envs.ALL)
STEPS = 30


def strong_actions(env: envs.BatchEnv, time: int) -> torch.Tensor:
    """Actions [learners, num_envs, da] that depend on the indices of learner and environment alone."""
    learners, num_envs, size = env.action_spec.shape
    learner = torch.arange(learners)[:, None, None] + env.options.first_learner
    copy, entry = torch.arange(num_envs)[:, None], torch.arange(size)
    return env.action_spec.space.high * torch.sin(0.7 * time + learner + 0.3 * copy + 0.5 * entry)


def run(task: str, **options) -> torch.Tensor:
    """A run with resets: every number of every step, [learners, num_envs, T, n]."""
    env = envs.make(task, seed=3, dtype=torch.float64, horizon=20, velocity_noise=0.01, info=True, **options)
    data, rows = env.reset(), []
    for time in range(STEPS):
        data["action"] = strong_actions(env, time)
        out, data = env.step_and_maybe_reset(data)
        out["next", "reset"] = data["observation"]
        rows.append(torch.cat([value.double() for value in out.values(True, True)], dim=-1))
    return torch.stack(rows, dim=2)


@EVERY_TASK
def test_specs_hold(task):
    check_env_specs(envs.make(task, learners=2, num_envs=2, info=True))


@EVERY_TASK
def test_a_learner_alone_runs_as_in_a_batch_bit_for_bit(task):
    many = run(task, learners=3, num_envs=11, threads=2)
    alone = run(task, learners=1, num_envs=2, threads=1, first_learner=2)
    assert torch.equal(many[2:, :2], alone)


@EVERY_TASK
def test_no_number_is_bad_and_the_parts_add_up_to_the_reward(task):
    env = envs.make(task, learners=2, num_envs=3, seed=1, dtype=torch.float64, info=True)
    out = env.rollout(STEPS, break_when_any_done=False)["next"]
    assert all(value.double().isfinite().all() for value in out.values(True, True))
    torch.testing.assert_close(sum(out["info"].values()), out["reward"], rtol=1e-6, atol=1e-6)
    assert torch.equal(out["done"], out["terminated"] | out["truncated"])


@pytest.mark.parametrize("task", [name for name, task in envs.ALL.items() if task not in gym.TASKS])
def test_no_entry_of_an_observation_is_constant(task):
    seen = envs.make(task, num_envs=8, seed=2, dtype=torch.float64).rollout(STEPS, break_when_any_done=False)
    spread = seen["observation"].flatten(0, 2).std(dim=0)
    assert (spread > 0).all()


@EVERY_TASK
def test_the_bounds_of_actions_are_not_empty_and_the_horizon_is_kept(task):
    env = envs.make(task, horizon=3)
    assert (env.action_spec.space.low < env.action_spec.space.high).all()
    out = env.rollout(7, break_when_any_done=False)["next"]
    steps = 0
    for done, truncated in zip(out["done"].flatten(), out["truncated"].flatten(), strict=True):
        steps += 1
        assert truncated == (steps == 3)
        steps = 0 if done else steps


@EVERY_TASK
def test_planes_and_observations_agree(task):
    plane = envs.ALL[task].plane
    if plane is None:
        return
    low, high = torch.tensor(plane.low).double(), torch.tensor(plane.high).double()
    points = low + (high - low) * torch.rand(40, 2, dtype=torch.float64)
    seen = plane.to_observation(points)
    assert seen.shape[-1] == envs.make(task).observation_spec["observation"].shape[-1]
    torch.testing.assert_close(plane.from_observation(seen), points)


@EVERY_TASK
def test_it_can_be_drawn_without_opengl(task, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    env = envs.make(task)
    env.reset()
    with pytest.warns(UserWarning, match="sketches"):
        frame = env.render(width=96, height=64)
    assert frame.shape == (64, 96, 3)
    assert frame.float().std() > 1
