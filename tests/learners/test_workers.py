"""Workers: the learner's policy and critic in several processes, whole versions only, and failures named."""

import contextlib
import functools
import os
import signal
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

import envs
from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig, QLearning, QLearningConfig
from torch_gprl.learners.board import PLAIN, Board, FollowingPolicy
from torch_gprl.learners.workers import ReportingCollector, WorkerCollection, copied_for_workers, made
from torch_gprl.policies import ConfidenceNoise, GaussianPolicy, LinearController, gaussian_policy
from torch_gprl.policies.streams import NoiseStream

LEARNERS, ENVS, STEPS = 2, 3, 10


def pendulums(seed: int) -> EnvBase:
    return envs.make("pendulum-swingup", learners=LEARNERS, num_envs=ENVS, seed=seed, threads=1)


def gaussian() -> GaussianPolicy:
    controller = LinearController(3, 1, (LEARNERS,))
    return gaussian_policy(controller, pendulums(0).action_spec, seed=0)


def taught_critic(*weights: float) -> GPActionValue:
    """A critic that knows different corners of the state space, the further the more it was taught."""
    gp = SparseOnlineGP(SquaredExponential(4, batch_shape=(LEARNERS,)), 20, 0.01)
    critic = GPActionValue(gp, action_low=torch.tensor([-5.0]), action_high=torch.tensor([5.0]))
    for weight in weights:
        inputs = weight * torch.randn(LEARNERS, 10, 4)
        gp.update(inputs, inputs.sum(-1))
    return critic


def exploring(critic: GPActionValue) -> ConfidenceNoise:
    return ConfidenceNoise(lambda seen: seen[..., :1], critic, noise=NoiseStream(0, range(LEARNERS)))


def states(count: int = 4) -> TensorDict:
    return TensorDict({"observation": torch.randn(LEARNERS, count, 3)}, (LEARNERS, count))


# ---------------------------------------------------------------- what workers follow


def test_a_worker_takes_up_policy_and_critic(tmp_path: Path):
    critic = taught_critic(1.0)
    modules = nn.ModuleDict({"policy": exploring(critic), "critic": critic})
    board, (copied,) = Board(tmp_path), copied_for_workers(modules, 1)
    board.post(modules)
    worker = FollowingPolicy(copied, tmp_path)
    seen = states()
    before = worker(seen.clone())["action_std"]
    torch.testing.assert_close(before, modules["policy"](seen.clone())["action_std"])

    inputs = torch.randn(LEARNERS, 30, 4)
    critic.gp.update(inputs, inputs.sum(-1))
    assert torch.equal(worker(seen.clone())["action_std"], before)  # not told yet
    board.post(modules)
    after = worker(seen.clone())["action_std"]
    torch.testing.assert_close(after, modules["policy"](seen.clone())["action_std"])
    assert (after < before).any()


def test_a_worker_takes_up_what_is_annealed(tmp_path: Path):
    env = pendulums(0)
    learner = QLearning(env, QLearningConfig(final_std=0.0))
    modules = nn.ModuleDict({"policy": learner.policy, "critic": learner.critic})
    board, (copied,) = Board(tmp_path), copied_for_workers(modules, 1)
    board.post(modules)
    worker = FollowingPolicy(copied, tmp_path)
    state = env.reset()
    uniform = worker(state.clone())["action"]
    assert len(uniform.unique()) == uniform.numel()  # nothing is known yet

    learner.policy.uniform = False
    learner.policy.anneal(1.0)
    board.post(modules)
    acted = [policy(state.clone())["action"] for policy in (worker, learner.policy)]
    torch.testing.assert_close(acted[0], acted[1])  # without noise


def test_a_worker_keeps_the_functions_that_its_episodes_act_on(tmp_path: Path):
    learner = QLearning(pendulums(0), QLearningConfig(exploration="thompson", budget=20))
    modules = nn.ModuleDict({"policy": learner.policy, "critic": learner.critic})
    learner.policy.uniform = False
    board, (copied,) = Board(tmp_path), copied_for_workers(modules, 1)
    board.post(modules)
    worker = FollowingPolicy(copied, tmp_path)
    state = pendulums(0).reset().set("step_count", torch.zeros(LEARNERS, ENVS, 1, dtype=torch.long))
    first = worker(state.clone())["action"]
    board.post(modules)  # news, of the same content
    middle = worker(state.clone().set("step_count", torch.ones(LEARNERS, ENVS, 1, dtype=torch.long)))
    assert torch.equal(middle["action"], first)
    assert not torch.equal(worker(state.clone())["action"], first)  # another episode


def test_half_of_a_change_is_not_read(tmp_path: Path):
    modules = nn.ModuleDict({"policy": nn.Linear(2, 2)})
    writer, reader = Board(tmp_path), Board(tmp_path)
    writer.post(modules)
    version, whole = reader.read(0)
    assert reader.read(version) is None
    assert writer._posted is not None

    writer._posted["head"].add_(1)  # a change begins, and stops half-way
    writer._posted["state", "policy.weight"].fill_(7.0)
    assert reader.read(0) is None
    writer._posted["state", "policy.bias"].fill_(7.0)
    writer._posted["tail"].copy_(writer._posted["head"])
    following, changed = reader.read(version)
    assert following == version + 1
    assert all(bool((changed[name] == 7).all()) for name in whole if name != PLAIN)


def test_workers_draw_numbers_of_their_own():
    policy = gaussian()
    copies = copied_for_workers(nn.ModuleDict({"policy": policy}), 2)
    seen = states()
    actions = [one["policy"](seen.clone())["action"] for one in (*copies, {"policy": policy})]
    for one in range(3):
        for other in range(one):
            assert not (actions[one] == actions[other]).any()
    again = copied_for_workers(nn.ModuleDict({"policy": gaussian()}), 2)
    assert torch.equal(again[1]["policy"](seen.clone())["action"], actions[1])


def a_worker(folder: Path, seed: int) -> ReportingCollector:
    """What a process of synchronous workers runs, here."""
    critic = taught_critic(1.0)
    modules = nn.ModuleDict({"policy": exploring(critic), "critic": critic})
    Board(folder / "board").post(modules)
    (copied,) = copied_for_workers(modules, 1)
    return ReportingCollector(
        functools.partial(made, functools.partial(pendulums, seed)),
        FollowingPolicy(copied, folder / "board"),
        frames_per_batch=STEPS * LEARNERS * ENVS,
        total_frames=-1,
        auto_register_policy_transforms=False,
        reports=folder,
    )


def test_a_worker_goes_on_bit_for_bit_from_a_saved_state(tmp_path: Path):
    torch.manual_seed(0)
    one, other = (a_worker(tmp_path / name, seed) for seed, name in enumerate("ab"))
    rollouts = iter(one)
    next(rollouts), next(iter(other))
    other.load_state_dict(one.state_dict())
    for expected, came in zip(rollouts, other, strict=False):
        for key in ("observation", "action", "action_std", "step_count", ("next", "reward")):
            assert torch.equal(expected[key], came[key])
        if one._iter == 4:
            break


def test_workers_go_on_only_from_as_many_workers():
    factories = [functools.partial(pendulums, seed) for seed in range(2)]
    collection = WorkerCollection(factories, gaussian(), STEPS)
    for count in (1, 2, 3):
        workers = [{"simulation": {}}] * count
        collection.load_state_dict({"workers": workers})
        assert collection.state_dict() == {"workers": workers if count == 2 else []}
    collection.load_state_dict({"simulation": {"of": torch.zeros(1)}})  # of a collection in one process
    assert collection.state_dict() == {"workers": []}


def test_workers_need_factories():
    with pytest.raises(ValueError, match="one factory for each worker"):
        WorkerCollection([], gaussian(), STEPS)


# ---------------------------------------------------------------- processes


class Failing(envs.BatchEnv):
    """A pendulum whose simulation breaks, or whose process dies, after so many steps."""

    def __init__(self, after: int, how: str) -> None:
        options = envs.make("pendulum-swingup", learners=LEARNERS, num_envs=ENVS, threads=1).options
        super().__init__(envs.ALL["pendulum-swingup"], options)
        self.left, self.how = after, how

    def _outcome(self, tensordict: TensorDictBase) -> dict:
        self.left -= 1
        outcome = super()._outcome(tensordict)
        if self.left < 0 and self.how == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.left < 0:
            outcome["reward"] = outcome["reward"] * torch.nan
        return outcome


def learner_with(factories, asynchronous: bool, updates: int = 4) -> PolicyGradient:
    total = len(factories) * ENVS if not asynchronous else ENVS
    env = envs.make("pendulum-swingup", learners=LEARNERS, num_envs=total, threads=1)
    config = PolicyGradientConfig(total_frames=updates * total * 50, rollout_steps=50, budget=20)
    learner = PolicyGradient(env, config)
    learner.collection = WorkerCollection(
        factories, learner.policy, config.rollout_steps, asynchronous=asynchronous
    )
    return learner


@pytest.mark.slow
@pytest.mark.parametrize("asynchronous", [False, True])
def test_workers_act_by_the_learners_critic(asynchronous):
    critic = taught_critic(0.1)
    policy = exploring(critic)
    factories = [functools.partial(pendulums, seed) for seed in range(2)]
    collection = WorkerCollection(factories, policy, STEPS, critic, asynchronous)
    with contextlib.closing(collection):
        for _ in range(4):
            rollout = collection.rollout()
        expected = policy(rollout.select("observation"))["action_std"]
        torch.testing.assert_close(rollout["action_std"], expected)
        inputs = torch.randn(LEARNERS, 50, 4)
        critic.gp.update(inputs, inputs.sum(-1))
        for _ in range(4 if asynchronous else 1):  # those on their way are older
            rollout = collection.rollout()
    assert rollout.shape == (LEARNERS, (1 if asynchronous else 2) * ENVS, STEPS)
    expected = policy(rollout.select("observation"))["action_std"]
    torch.testing.assert_close(rollout["action_std"], expected)
    assert len(rollout["observation"][0, :, 0, 0].unique()) == rollout.shape[1]


@pytest.mark.slow
def test_a_learner_learns_from_synchronous_workers_and_repeats_itself():
    factories = [functools.partial(pendulums, seed) for seed in range(2)]
    figures = []
    for _ in range(2):
        learner = learner_with(factories, asynchronous=False)
        with contextlib.closing(learner.collection):
            figures.append(torch.stack([row["gradient_norm"] for row in learner.train()]))
    assert figures[0].isfinite().all()
    assert torch.equal(figures[0], figures[1])


@pytest.mark.slow
def test_a_resumed_learner_with_synchronous_workers_goes_on_bit_for_bit(tmp_path: Path):
    factories = [functools.partial(pendulums, seed) for seed in range(2)]
    learner, rows = learner_with(factories, asynchronous=False), []
    with contextlib.closing(learner.collection):
        for figures in learner.train():
            rows.append(figures["gradient_norm"])
            if learner.updates == 2:
                torch.save(learner.state_dict(), tmp_path / "state.pt")
    other = learner_with(factories, asynchronous=False)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    with contextlib.closing(other.collection):
        again = [figures["gradient_norm"] for figures in other.train()]
    assert torch.equal(torch.stack(rows[2:]), torch.stack(again))


@pytest.mark.slow
@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize(
    ("how", "cause"), [("killed", "exit code -9"), ("diverged", "worker-1: FloatingPointError: .*reward")]
)
def test_a_failed_worker_ends_the_run_with_its_cause_and_a_usable_state(how, cause, asynchronous):
    factories = [functools.partial(pendulums, 0), functools.partial(Failing, 70, how)]
    learner = learner_with(factories, asynchronous, updates=1000)
    with contextlib.closing(learner.collection), pytest.raises(RuntimeError, match=cause):
        list(learner.train())
    other = PolicyGradient(learner.env, learner.config)
    other.load_state_dict(learner.state_dict())
    before = other.updates
    assert 1 <= before < 1000
    assert next(other.train())["gradient_norm"].isfinite().all()
    assert other.updates == before + 1
