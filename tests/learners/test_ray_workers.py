"""Ray's workers: the same policy and critic, other random numbers, and a clear word where Ray is missing."""

import contextlib
import copy
import functools
import importlib.util
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import EnvBase

import envs
from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.learners.ray_workers import CarriedPolicy, RayCollection, RayWorker
from torch_gprl.learners.workers import made
from torch_gprl.policies import ConfidenceNoise
from torch_gprl.policies.streams import NoiseStream

LEARNERS, ENVS, STEPS = 2, 3, 10


def pendulums(seed: int) -> EnvBase:
    return envs.make("pendulum-swingup", learners=LEARNERS, num_envs=ENVS, seed=seed, threads=1)


def first_column(seen: torch.Tensor) -> torch.Tensor:
    return seen[..., :1]


def scene() -> tuple[ConfidenceNoise, GPActionValue]:
    gp = SparseOnlineGP(SquaredExponential(4, batch_shape=(LEARNERS,)), 20, 0.01)
    critic = GPActionValue(gp, action_low=torch.tensor([-5.0]), action_high=torch.tensor([5.0]))
    noise = NoiseStream(0, range(LEARNERS))
    return ConfidenceNoise(first_column, critic, noise=noise), critic


def learn(critic: GPActionValue) -> None:
    inputs = torch.randn(LEARNERS, 50, 4)
    critic.gp.update(inputs, inputs.sum(-1))


def test_what_arrives_as_bare_tensors_is_taken_up():
    policy, critic = scene()
    carried = CarriedPolicy(nn.ModuleDict({"policy": policy, "critic": critic}))
    worker = copy.deepcopy(carried)
    states = TensorDict({"observation": torch.randn(LEARNERS, 4, 3)}, (LEARNERS, 4))
    worker(states.clone())
    learn(critic)
    carried.mark()
    TensorDict.from_module(worker).data.update_(TensorDict.from_module(carried).data)  # as TorchRL does
    torch.testing.assert_close(worker(states.clone())["action_std"], policy(states.clone())["action_std"])


def test_every_worker_draws_numbers_of_its_own():
    policy, _ = scene()
    workers = [CarriedPolicy(copy.deepcopy(nn.ModuleDict({"policy": policy}))) for _ in range(3)]
    for index, worker in enumerate(workers):
        worker.begin(index)
    states = TensorDict({"observation": torch.randn(LEARNERS, 4, 3)}, (LEARNERS, 4))
    actions = [worker(states.clone())["action"] for worker in workers]
    assert all(not (actions[i] == actions[j]).any() for i, j in ((0, 1), (0, 2), (1, 2)))


def test_without_ray_the_way_out_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torch-gprl\[ray\]'"):
        RayCollection([functools.partial(pendulums, 0)], scene()[0], STEPS)


def nowhere() -> EnvBase:
    raise OSError("no simulator on this machine")


def ray_options() -> dict:
    paths = {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    options = {"num_cpus": 2, "include_dashboard": False, "log_to_driver": False}
    return options | {"runtime_env": {"env_vars": paths}}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_worker_that_fails_tells_why():
    pytest.importorskip("ray", reason="needs the extra ray")
    factories = [functools.partial(pendulums, 0), nowhere]
    collection = RayCollection(factories, scene()[0], STEPS, cpus=0.5, ray_options=ray_options())
    with (
        contextlib.closing(collection),
        pytest.raises(RuntimeError, match=r"(?s)a worker failed.*no simulator"),
    ):
        collection.rollout()


def a_worker(carried: CarriedPolicy, seed: int) -> RayWorker:
    """What one of Ray's processes runs, here."""
    return RayWorker(
        functools.partial(made, functools.partial(pendulums, seed)),
        copy.deepcopy(carried),
        worker=seed,
        frames_per_batch=STEPS * LEARNERS * ENVS,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )


def test_a_worker_goes_on_bit_for_bit_from_a_saved_state():
    policy, critic = scene()
    modules = nn.ModuleDict({"policy": policy, "critic": critic})
    carried, resumed = CarriedPolicy(modules), CarriedPolicy(modules)
    learn(critic)
    carried.mark()
    one = a_worker(carried, 0)
    rollouts = iter(one)
    next(rollouts)
    state = one.state_dict()
    learn(critic)
    carried.mark(), resumed.mark()  # in a resumed run the versions begin anew
    other = a_worker(resumed, 1)
    other.load_state_dict(state)
    for worker, learned in ((one, carried), (other, resumed)):
        TensorDict.from_module(worker.policy).data.update_(TensorDict.from_module(learned).data)
    for expected, came in zip(rollouts, other, strict=False):
        for key in ("observation", "action", "action_std", ("next", "reward")):
            assert torch.equal(expected[key], came[key])
        torch.testing.assert_close(came["action_std"], policy(came.select("observation"))["action_std"])
        if one._iter == 3:
            break


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_rays_workers_act_by_the_learners_critic():
    pytest.importorskip("ray", reason="needs the extra ray")
    policy, critic = scene()
    factories = [functools.partial(pendulums, seed) for seed in range(2)]
    collection = RayCollection(factories, policy, STEPS, critic, cpus=0.5, ray_options=ray_options())
    with contextlib.closing(collection):
        for _ in range(2):
            learn(critic)
            rollout = collection.rollout()
            assert rollout.shape == (LEARNERS, 2 * ENVS, STEPS)
            expected = policy(rollout.select("observation"))["action_std"]
            torch.testing.assert_close(rollout["action_std"], expected)
    assert len(rollout["action"][0, :, 0, 0].unique()) == 2 * ENVS
