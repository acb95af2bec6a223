"""The environments inside TorchRL's collectors, process pools and video recorder."""

import functools

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, TransformedEnv
from torchrl.record import PixelRenderTransform, VideoRecorder
from torchrl.record.loggers import CSVLogger

import envs


def test_a_collector_gives_rollouts_of_learners_by_environments_by_time():
    env = envs.make("pendulum-balance", learners=2, num_envs=3, seed=1, horizon=10)
    collector = Collector(env, frames_per_batch=120, total_frames=240, trajs_per_batch=None)
    batches = list(collector)
    collector.shutdown()
    assert [batch.batch_size for batch in batches] == [(2, 3, 20)] * 2
    joined = torch.cat(batches, dim=-1)
    # What an agent sees next is what the step before left, except where a new episode began.
    same = (joined["observation"][..., 1:, :] == joined["next", "observation"][..., :-1, :]).all(-1)
    assert torch.equal(same, ~joined["next", "done"][..., :-1, 0])


def test_torchrls_video_recorder_writes_what_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    logger = CSVLogger("run", str(tmp_path), video_format="pt")
    env = TransformedEnv(envs.make("pendulum-swingup", num_envs=2))
    env.append_transform(PixelRenderTransform(render_method="render_all", width=64, height=48))
    recorder = VideoRecorder(logger, tag="swing", in_keys=["pixels"], make_grid=False, skip=1)
    env.append_transform(recorder)
    with pytest.warns(UserWarning, match="sketches"):
        out = env.rollout(5)
    assert out["pixels"].shape == (1, 2, 5, 48, 64, 3)
    recorder.dump()
    video = torch.load(next(tmp_path.rglob("*.pt")))
    assert video.shape == (1, 2 * 6, 3, 48, 64)  # each environment's start and five steps
    assert video.float().std() > 1


@pytest.mark.slow
def test_a_parallel_environment_steps_as_its_members_do():
    makers = [
        functools.partial(envs.make, "cartpole-balance", learners=2, num_envs=2, seed=seed) for seed in (1, 2)
    ]
    pool = ParallelEnv(2, makers)
    try:
        pooled = pool.rollout(10, policy=still, break_when_any_done=False)
    finally:
        pool.close()
    for maker, part in zip(makers, pooled, strict=True):
        alone = maker().rollout(10, policy=still, break_when_any_done=False)
        assert torch.equal(part["next", "observation"], alone["next", "observation"])


def still(observation):
    """The policy that does nothing; TorchRL wraps it."""
    return torch.zeros(*observation.shape[:-1], 1)


@pytest.mark.slow
def test_collectors_in_processes_work():
    maker = functools.partial(envs.make, "pendulum-swingup", learners=1, num_envs=4)
    collector = Collector(
        maker,
        still,
        frames_per_batch=160,
        total_frames=320,
        backend="process",
        num_collectors=2,
        sync=True,
    )
    try:
        batches = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    assert sum(batch.numel() for batch in batches) == 320
    assert all(batch["next", "reward"].isfinite().all() for batch in batches)
