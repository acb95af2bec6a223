"""The batched environment: what TorchRL asks of it, and what does not depend on the batch."""

import io
import math

import pytest
import torch
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

import envs

NOISE = {"observation_noise": 0.1, "action_noise": 0.2, "velocity_noise": 0.3}


def actions(env: envs.BatchEnv, steps: int) -> torch.Tensor:
    """[T, learners, num_envs, da] reproducible actions, some out of bounds; the same for each index pair."""
    learners, num_envs, size = env.action_spec.shape
    time, learner, copy, entry = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float32) for n in (steps, learners, num_envs, size)), indexing="ij"
    )
    return 6 * torch.sin(1.7 * time + 0.9 * (learner + env.options.first_learner) + 0.4 * copy + entry)


def run(env: envs.BatchEnv, steps: int = 70):
    """Observations, rewards and ends of a rollout with resets: [learners, num_envs, T, ...]."""
    data, steps_out = env.reset(), []
    for action in actions(env, steps):
        data["action"] = action
        out, data = env.step_and_maybe_reset(data)
        steps_out.append(out)
    stacked = torch.stack(steps_out, dim=2)
    return torch.cat([stacked["observation"], stacked["next", "observation"]], -1), stacked["next"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("info", [True, False])
def test_specs_hold(dtype, info):
    env = envs.make("pendulum-balance", learners=2, num_envs=3, dtype=dtype, info=info)
    check_env_specs(env)
    assert env.batch_size == (2, 3)
    assert env.reset()["observation"].dtype == dtype


@pytest.mark.parametrize("noise", [{}, NOISE], ids=["default", "noisy"])
def test_a_trajectory_depends_neither_on_the_batch_nor_on_threads(noise):
    """Bit for bit, over several episodes of different lengths."""
    many = envs.make("pendulum-balance", learners=3, num_envs=40, seed=9, threads=2, horizon=12, **noise)
    few = envs.make(
        "pendulum-balance", learners=1, num_envs=3, seed=9, threads=1, horizon=12, first_learner=1, **noise
    )
    (seen, next_many), (seen_few, next_few) = run(many), run(few)
    assert torch.equal(seen[1:2, :3], seen_few)
    for key in ("reward", "terminated", "truncated"):
        assert torch.equal(next_many[key][1:2, :3], next_few[key])
    assert next_many["terminated"].any()
    assert next_many["truncated"].any()


def test_seeds_learners_and_environments_differ_and_repeat():
    def start(**options):
        return envs.make("pendulum-swingup", **options).reset()["observation"]

    base = start(learners=2, num_envs=2, seed=1)
    assert torch.equal(base, start(learners=2, num_envs=2, seed=1))
    assert base.reshape(4, -1).unique(dim=0).shape[0] == 4
    assert not torch.isin(start(learners=2, num_envs=2, seed=2)[..., 1], base[..., 1]).any()


def test_set_seed_starts_the_streams_anew():
    env = envs.make("pendulum-swingup", num_envs=2, seed=5)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert not torch.equal(first, second)
    env.set_seed(5)
    assert torch.equal(env.reset()["observation"], first)


def test_only_masked_environments_are_reset():
    env = envs.make("pendulum-swingup", learners=2, num_envs=2, **NOISE)
    data = env.rollout(5)[..., -1]["next"]
    before = env.qpos
    mask = torch.tensor([[True, False], [False, True]]).unsqueeze(-1)
    seen = data["observation"].clone()
    data["_reset"] = mask
    out = env.reset(data)
    assert torch.equal(env.qpos[~mask], before[~mask])
    assert (env.qpos[mask] != before[mask]).all()
    assert torch.equal(out["observation"][~mask.squeeze(-1)], seen[~mask.squeeze(-1)])


def test_a_reset_of_none_changes_nothing():
    env = envs.make("Hopper-v5", num_envs=2)
    data = env.reset()
    before = env.qpos
    data["_reset"] = torch.zeros(1, 2, 1, dtype=torch.bool)
    env.reset(data)
    assert torch.equal(env.qpos, before)


def test_actions_with_gradients_are_taken_by_value():
    env = envs.make("pendulum-swingup", num_envs=2)
    data = env.reset()
    data["action"] = torch.zeros(env.action_spec.shape, requires_grad=True)
    assert not env.step(data)["next", "reward"].requires_grad


def test_a_time_limit_truncates_and_does_not_terminate():
    env = envs.make("pendulum-swingup", num_envs=2, horizon=7)
    out = env.rollout(20, break_when_any_done=False)["next"]
    expected = torch.arange(1, 21).remainder(7) == 0
    assert torch.equal(out["truncated"][0, 0, :, 0], expected)
    assert torch.equal(out["done"], out["truncated"])
    assert not out["terminated"].any()


@pytest.mark.parametrize("info", [True, False])
def test_the_short_way_through_a_step_gives_what_torchrls_own_gives(info):
    """The same entries, nested ones of other programs included, at every step of runs with resets."""
    pair = [envs.make("pendulum-balance", num_envs=3, seed=1, horizon=9, info=info) for _ in range(2)]
    now = [env.reset() for env in pair]
    for time in range(20):
        for env, data in zip(pair, now, strict=True):
            data["action"] = actions(env, 20)[time]
            data["collector", "ids"] = torch.full((1, 3), time)
        ours = pair[0].step_and_maybe_reset(now[0])
        theirs = EnvBase.step_and_maybe_reset(pair[1], now[1])
        for mine, other in zip(ours, theirs, strict=True):
            assert set(mine.keys(True, True)) == set(other.keys(True, True))
            assert (mine == other).all()
        assert ours[1]["collector"] is not ours[0]["collector"]
        now = [ours[1], theirs[1]]


def test_transforms_see_whole_episodes():
    env = TransformedEnv(envs.make("pendulum-swingup", num_envs=3, horizon=10), RewardSum())
    out = env.rollout(20, break_when_any_done=False)["next"]
    for episode in (slice(0, 10), slice(10, 20)):
        torch.testing.assert_close(
            out["episode_reward"][..., episode, :][..., -1, :], out["reward"][..., episode, :].sum(-2)
        )


def test_noise_has_the_stated_deviation():
    # 5,000 differences each; bounds at 5 standard errors of a standard deviation.
    def final(**noise):
        options = {"velocity_noise": 0.0, "num_envs": 5_000, "threads": 1, "dtype": torch.float64}
        env = envs.make("pendulum-explore", **(options | noise))
        env.place(torch.zeros(1, 5_000, 1).double(), torch.zeros(1, 5_000, 1).double())
        data = env.step(env.full_action_spec.zero())
        return data["next", "observation"], env.qvel

    tolerance = 5 / math.sqrt(2 * 5_000)
    quiet = final()
    assert (final(velocity_noise=0.3)[1] - quiet[1]).std().item() == pytest.approx(0.3, rel=tolerance)
    assert (final(observation_noise=0.2)[0] - quiet[0]).std().item() == pytest.approx(0.2, rel=tolerance)
    # From rest upright the velocity after a step is proportional to the torque: 0.05 s of u / (m l²), nearly.
    assert (final(action_noise=0.1)[1] - quiet[1]).std().item() == pytest.approx(0.005, rel=0.05)


@pytest.mark.parametrize("task", ["pendulum-balance", "Hopper-v5", "Ant-v5"])
def test_a_saved_environment_goes_on_bit_for_bit(task):
    env = envs.make(task, num_envs=3, seed=2, horizon=12, **NOISE)
    run(env, 40)
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    other = envs.make(task, num_envs=3, seed=4, horizon=12, **NOISE)
    other.load_state_dict(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    for _ in range(50):
        outs = [e.step(e.full_action_spec.zero())["next"] for e in (env, other)]
        assert torch.equal(outs[0]["observation"], outs[1]["observation"])
        assert torch.equal(outs[0]["reward"], outs[1]["reward"])
        assert torch.equal(outs[0]["truncated"], outs[1]["truncated"])
        for e, out in zip((env, other), outs, strict=True):
            e.maybe_reset(out)


def test_a_saved_environment_fits_only_its_like():
    saved = envs.make("pendulum-balance", num_envs=3).state_dict()
    with pytest.raises(ValueError, match="same task, learners and num_envs"):
        envs.make("pendulum-balance", num_envs=4).load_state_dict(saved)


def test_an_action_that_is_not_finite_is_named():
    env = envs.make("pendulum-swingup", learners=2, num_envs=3)
    data = env.reset()
    data["action"] = torch.zeros(2, 3, 1)
    data["action"][1, 2] = math.nan
    with pytest.raises(ValueError, match="learner 1, environment 2 is nan"):
        env.step(data)


def test_an_action_of_the_wrong_shape_is_named():
    env = envs.make("pendulum-swingup", learners=2, num_envs=3)
    data = env.reset()
    data["action"] = torch.zeros(2, 3, 2)
    with pytest.raises(ValueError, match=r"= \[2, 3, 1\], not \[2, 3, 2\]"):
        env.step(data)


def test_a_diverged_simulation_ends_and_leaves_no_bad_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log where it runs
    env = envs.make("Ant-v5", num_envs=3, info=True)
    env.reset()
    qvel = torch.zeros_like(env.qvel)
    qvel[0, 1] = 1e9
    env.place(env.qpos, qvel)
    with pytest.warns(RuntimeWarning, match="learner 0, environment 1 diverged with a bad acceleration"):
        out = env.step(env.full_action_spec.zero())["next"]
    assert out["terminated"].flatten().tolist() == [False, True, False]
    assert all(value.double().isfinite().all() for value in out.values(True, True))
    assert env.divergences == 1


@pytest.mark.parametrize("task", ["pendulum-swingup", "car-on-hill"])
def test_lost_simulations_are_counted_and_warned_of_once(task):
    env = envs.make(task, num_envs=3, velocity_noise=1e12)
    env.reset()
    with pytest.warns(RuntimeWarning, match="not finite or beyond 1e") as warned:
        out = env.rollout(4, break_when_any_done=False)["next"]
    assert len(warned) == 1
    assert out["terminated"].all()
    assert all(value.double().isfinite().all() for value in out.values(True, True))
    assert env.divergences == 12


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("learners", 0),
        ("num_envs", -1),
        ("horizon", 0),
        ("threads", 0),
        ("velocity_noise", -0.1),
        ("dtype", torch.bfloat16),
    ],
)
def test_an_option_out_of_range_is_refused(option, value):
    with pytest.raises(ValueError, match=f"{option} .*not {value}"):
        envs.make("pendulum-swingup", **{option: value})


def test_an_unknown_task_names_the_nearest_and_all():
    with pytest.raises(ValueError, match="did you mean 'pendulum-swingup'") as error:
        envs.make("pendulum-swing-up")
    for task in envs.ALL:
        assert task in str(error.value)
