"""The tasks through Gymnasium's doors: its checkers, and agreement with the TorchRL side."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import envs

QUICK = ["pendulum-balance", "Hopper-v5"]


@pytest.mark.parametrize("task", envs.ALL)
def test_gymnasiums_checker_finds_nothing(task):
    env = gymnasium.make(f"torch_gprl/{task}")
    assert env.spec.max_episode_steps == envs.ALL[task].horizon
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", QUICK)
def test_gymnasiums_checker_finds_nothing_in_frames(task):
    env = gymnasium.make(f"torch_gprl/{task}", render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert frame.shape == (480, 480, 3)
    assert frame.std() > 1


@pytest.mark.parametrize("task", envs.ALL)
def test_vector_and_torchrl_give_the_same_numbers(task):
    vector = gymnasium.make_vec(f"torch_gprl/{task}", num_envs=3)
    batch = envs.make(task, num_envs=3, seed=4)
    seen, _ = vector.reset(seed=4)
    data = batch.reset()
    np.testing.assert_array_equal(data["observation"][0].numpy(), seen)
    rng, high = np.random.default_rng(0), batch.action_spec.space.high[0].numpy()
    for _ in range(10):
        # Shares whose product with the bounds is exact, so that both sides get the same forces.
        shares = rng.choice([-0.5, 0.0, 0.25], vector.action_space.shape).astype(np.float32)
        seen, reward, terminated, truncated, infos = vector.step(shares)
        data["action"] = torch.from_numpy(shares * high)[None]
        out = batch.step(data)["next"]
        np.testing.assert_array_equal(out["observation"][0].numpy(), seen)
        np.testing.assert_array_equal(out["reward"][0, :, 0].numpy(), reward.astype(np.float32))
        np.testing.assert_array_equal(out["terminated"][0, :, 0].numpy(), terminated)
        assert all(len(part) == 3 for part in infos.values())
        if (terminated | truncated).any():
            break
        data = out


@pytest.mark.parametrize("task", QUICK)
def test_done_environments_are_reset_one_step_later(task):
    env = gymnasium.make_vec(f"torch_gprl/{task}", num_envs=2, max_episode_steps=5)
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    ends = [env.step(still)[3].copy() for _ in range(13)]
    # Five steps, then one that only resets.
    assert [end.all() for end in ends] == [(i + 1) % 6 == 5 for i in range(13)]
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.NEXT_STEP


def test_a_reset_step_pays_nothing():
    env = gymnasium.make_vec("torch_gprl/cartpole-balance", num_envs=2, max_episode_steps=2)
    env.reset(seed=0)
    still = np.zeros((2, 1), dtype=np.float32)
    assert [env.step(still)[1].tolist() for _ in range(4)] == [[1, 1], [1, 1], [0, 0], [1, 1]]


def test_a_reset_mask_leaves_the_others_alone():
    env = gymnasium.make_vec("torch_gprl/pendulum-swingup", num_envs=3)
    before, _ = env.reset(seed=0)
    after, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert (before == after).all(axis=1).tolist() == [True, False, True]


def test_a_time_limit_of_the_users_own_holds():
    env = gymnasium.make("torch_gprl/pendulum-swingup", max_episode_steps=250)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, dtype=np.float32))[3] for _ in range(250)]
    assert ends.index(True) == 249


def test_noise_can_be_switched_off():
    steps = []
    for seed in (0, 1):
        env = gymnasium.make_vec("torch_gprl/pendulum-swingup", num_envs=1, noise=envs.Noise())
        env.reset(seed=seed)
        env.unwrapped._copies.place(np.ones((1, 1)), np.ones((1, 1)))
        steps.append(env.step(np.zeros((1, 1), dtype=np.float32))[0])
    np.testing.assert_array_equal(*steps)


@pytest.mark.parametrize("bad", [np.zeros((2, 1)), np.full((3, 1), np.nan)])
def test_bad_actions_are_named(bad):
    env = gymnasium.make_vec("torch_gprl/pendulum-swingup", num_envs=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"finite and of shape \(3, 1\)"):
        env.step(bad)


def test_a_list_of_seeds_is_refused():
    env = gymnasium.make_vec("torch_gprl/pendulum-swingup", num_envs=2)
    with pytest.raises(ValueError, match="one number, not"):
        env.reset(seed=[1, 2])


def test_gymnasiums_own_vector_environments_run_them():
    env = gymnasium.make_vec("torch_gprl/pendulum-swingup", num_envs=2, vectorization_mode="sync")
    seen, _ = env.reset(seed=0)
    assert seen.shape == (2, 3)
    env.close()
