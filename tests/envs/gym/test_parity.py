"""Bit for bit: our batch against Gymnasium's own environments, over 2,000 steps with resets."""

import gymnasium
import numpy as np
import pytest
import torch

import envs
from envs.gym import TASKS, classic

MUJOCO_TASKS = [task.id for task in TASKS if task not in classic.TASKS]
SEED = 11
COPIES = 2


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo leaves a log of its warnings about Gymnasium's models where it runs."""
    monkeypatch.chdir(tmp_path)


def reference(task: str, seed: int, actions: np.ndarray, horizon: int) -> dict[str, np.ndarray]:
    """What Gymnasium gives for actions [T, da], with a reset after every end."""
    env = gymnasium.make(task, max_episode_steps=horizon)
    seen, _ = env.reset(seed=seed)
    out = {"observation": [], "next": [], "reward": [], "terminated": [], "truncated": []}
    for action in actions:
        after, reward, terminated, truncated, _ = env.step(action)
        row = (seen, after, reward, terminated, truncated)
        for values, value in zip(out.values(), row, strict=True):
            values.append(value)
        seen = env.reset()[0] if terminated or truncated else after
    env.close()
    return {key: np.array(values) for key, values in out.items()}


def ours(task: str, actions: np.ndarray, horizon: int, dtype: torch.dtype) -> dict[str, np.ndarray]:
    """What our batch gives for actions [copies, T, da], as `reference` with a leading copy."""
    env = envs.make(task, num_envs=len(actions), seed=SEED, horizon=horizon, dtype=dtype)
    data, steps = env.reset(), []
    for action in torch.from_numpy(actions).transpose(0, 1):
        data["action"] = action[None]
        step, data = env.step_and_maybe_reset(data)
        steps.append(step)
    run = torch.stack(steps, dim=2)[0]
    flat = {key: run["next", key].squeeze(-1).numpy() for key in ("reward", "terminated", "truncated")}
    return {"observation": run["observation"].numpy(), "next": run["next", "observation"].numpy(), **flat}


def actions_for(task: str, steps: int) -> np.ndarray:
    """Half-strength random actions [copies, T, da], so that episodes are neither short nor dull."""
    rng = np.random.default_rng(3)
    high = np.array(envs.ALL[task].action_high, dtype=np.float32)
    return (rng.uniform(-0.5, 0.5, (COPIES, steps, len(high))) * high).astype(np.float32)


def compare(task: str, steps: int, horizon: int) -> None:
    actions = actions_for(task, steps)
    mine = ours(task, actions, horizon, torch.float64)
    for copy in range(COPIES):
        for key, value in reference(task, SEED + copy, actions[copy], horizon).items():
            np.testing.assert_array_equal(mine[key][copy], value, err_msg=f"{key} of copy {copy}")
    assert (mine["terminated"] | mine["truncated"]).any(), "no episode ended: the resets were not compared"


@pytest.mark.parametrize("task", MUJOCO_TASKS)
def test_short_episodes_equal_gymnasiums(task):
    compare(task, steps=100, horizon=40)


@pytest.mark.slow
@pytest.mark.parametrize("task", MUJOCO_TASKS)
def test_2000_steps_equal_gymnasiums(task):
    compare(task, steps=2000, horizon=gymnasium.spec(task).max_episode_steps)


@pytest.mark.parametrize("task", MUJOCO_TASKS)
def test_spaces_and_horizons_are_gymnasiums(task):
    env, batch = gymnasium.make(task), envs.make(task)
    assert batch.action_spec.shape[2:] == env.action_space.shape
    np.testing.assert_array_equal(batch.action_spec.space.low.flatten(), env.action_space.low)
    np.testing.assert_array_equal(batch.action_spec.space.high.flatten(), env.action_space.high)
    assert envs.ALL[task].horizon == env.spec.max_episode_steps
    assert envs.ALL[task].control_step == env.unwrapped.dt
    env.close()


def test_pendulum_equals_gymnasiums_in_its_float32():
    actions = actions_for("Pendulum-v1", 500)
    mine = ours("Pendulum-v1", actions, 200, torch.float32)
    for copy in range(COPIES):
        theirs = reference("Pendulum-v1", SEED + copy, actions[copy], 200)
        for key in ("observation", "next", "terminated", "truncated"):
            np.testing.assert_array_equal(mine[key][copy], theirs[key], err_msg=f"{key} of copy {copy}")
        np.testing.assert_array_equal(mine["reward"][copy], theirs["reward"].astype(np.float32))


def test_mountain_car_follows_gymnasiums_to_its_rounding():
    """Gymnasium rounds the state to float32 after each step; its error grows to a few 1e-5 in 200 steps."""
    actions = np.sign(np.sin(np.arange(200) / 17))[None, :, None].astype(np.float32)
    mine = ours("MountainCarContinuous-v0", actions, 999, torch.float64)
    theirs = reference("MountainCarContinuous-v0", SEED, actions[0], 999)
    np.testing.assert_allclose(mine["next"][0], theirs["next"], atol=1e-4)
    np.testing.assert_allclose(mine["reward"][0], theirs["reward"], atol=1e-6)
    assert theirs["terminated"].any()


def test_learners_have_generators_of_their_own():
    env = envs.make("Hopper-v5", learners=2, num_envs=3, seed=7, dtype=torch.float64)
    seen = env.reset()["observation"]
    theirs = gymnasium.make("Hopper-v5").reset(seed=7 + 65536 + 2)[0]
    np.testing.assert_array_equal(seen[1, 2], theirs)
