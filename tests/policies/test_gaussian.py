"""The Gaussian policy: its density, its units, its streams, and its life inside TorchRL."""

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Unbounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ReinforceLoss

import envs
from torch_gprl.policies import GaussianPolicy, LinearController, MLPController, gaussian_policy

LEARNERS = 3
LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])


def policy(*batch: int, seed: int | None = None, std: float = 0.5, **options: Any) -> GaussianPolicy:
    """A policy of observations [*, 4] and two actions of different range, with random weights."""
    controller = LinearController(4, 2, batch)
    with torch.no_grad():
        controller.weight.normal_(std=0.3)
    spec = Bounded(LOW, HIGH, shape=(2,), dtype=torch.float32)
    return gaussian_policy(controller, spec, std, seed, **options)


def states(*shape: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*shape, 4)}, shape)


def log_density(loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
    """Log of Π N(a; f, σ²), with 2σ² in the exponent."""
    return (
        -((action - loc).square() / (2 * scale.square()) + scale.log() + 0.5 * math.log(2 * math.pi))
    ).sum(-1)


@pytest.mark.parametrize("seed", [None, 7], ids=["global generator", "streams"])
@pytest.mark.parametrize("shape", [(LEARNERS,), (LEARNERS, 5), (LEARNERS, 5, 6)])
def test_the_log_probability_it_writes_is_that_of_its_distribution(seed, shape):
    acting = policy(LEARNERS, seed=seed)
    data = acting(states(*shape))
    assert data["action"].shape == data["loc"].shape == data["scale"].shape == (*shape, 2)
    assert data["action_log_prob"].shape == shape
    expected = log_density(data["loc"], data["scale"], data["action"])
    torch.testing.assert_close(data["action_log_prob"], expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(acting.get_dist(data).log_prob(data["action"]), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", [None, 7], ids=["global generator", "streams"])
def test_actions_have_the_mean_and_the_spread_it_says(seed):
    data = policy(LEARNERS, seed=seed)(states(LEARNERS, 20_000))
    noise = (data["action"] - data["loc"]) / data["scale"]
    # six standard errors each of 12 numbers: fewer than one failure in 10⁷ seeds
    assert (noise.mean(1).abs() < 6 / 20_000**0.5).all()
    assert ((noise.square().mean(1) - 1).abs() < 6 * (2 / 20_000) ** 0.5).all()


def test_a_full_stroke_of_the_controller_is_the_bound_of_the_actuator():
    acting = policy(LEARNERS, std=0.25)
    for level, expected in ((-1.0, LOW), (0.0, (LOW + HIGH) / 2), (1.0, HIGH)):
        controller = acting.head.controller
        assert isinstance(controller, LinearController)
        with torch.no_grad():
            controller.weight.zero_()
            controller.bias.fill_(level)
        data = acting(states(LEARNERS, 5))
        torch.testing.assert_close(data["loc"], expected.expand(LEARNERS, 5, 2))
        torch.testing.assert_close(data["scale"], (0.25 * (HIGH - LOW) / 2).expand(LEARNERS, 5, 2))
    torch.testing.assert_close(acting.std, (0.25 * (HIGH - LOW) / 2).expand(LEARNERS, 2))


@pytest.mark.parametrize("seed", [None, 7], ids=["global generator", "streams"])
@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MEAN, ExplorationType.MODE])
def test_without_exploration_the_action_is_the_controllers(seed, kind):
    with set_exploration_type(kind):
        data = policy(LEARNERS, seed=seed)(states(LEARNERS, 5))
    assert torch.equal(data["action"], data["loc"])


def test_what_a_learner_draws_does_not_depend_on_the_others():
    together, alone = policy(LEARNERS, seed=7), policy(1, seed=7, learners=[1])
    shared = {
        key: tensor[1:2] if tensor.shape[:1] == (LEARNERS,) else tensor
        for key, tensor in together.state_dict().items()
    }
    alone.load_state_dict(shared)
    for _ in range(70):
        data = states(LEARNERS, 4)
        expected = together(data.clone())["action"][1:2]
        torch.testing.assert_close(alone(data[1:2].clone())["action"], expected)


def test_the_same_seed_gives_the_same_actions_and_another_seed_others():
    data = states(LEARNERS, 4)
    one = policy(LEARNERS, seed=7)
    actions = []
    for seed in (7, 7, 8):
        other = policy(LEARNERS, seed=seed)
        other.load_state_dict(one.state_dict())
        actions.append(other(data.clone())["action"])
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


@pytest.mark.parametrize("learners", [1, LEARNERS])
def test_it_drives_an_environment(learners):
    env = envs.make("pendulum-swingup", learners=learners, num_envs=4, threads=1)
    acting = gaussian_policy(MLPController(3, 1, (learners,)), env.action_spec, seed=0)
    with torch.no_grad():
        rollout = env.rollout(20, acting)
    assert rollout["action"].shape == (learners, 4, 20, 1)
    expected = acting.get_dist(rollout).log_prob(rollout["action"])
    torch.testing.assert_close(rollout["action_log_prob"], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("loss", [ReinforceLoss, A2CLoss])
def test_torchrls_losses_train_the_controller(loss):
    env = envs.make("pendulum-swingup", num_envs=4, threads=1)
    acting = gaussian_policy(MLPController(3, 1, (1,)), env.action_spec, seed=0)
    with torch.no_grad():
        rollout = env.rollout(20, acting)
    critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
    objective = loss(acting, critic)
    objective.make_value_estimator(gamma=0.9)
    losses = objective(rollout)
    sum(losses[key] for key in losses.keys() if key.startswith("loss_")).backward()  # noqa: SIM118
    gradients = {name: parameter.grad for name, parameter in acting.named_parameters()}
    # the last layer starts at zero, so that the first layers get no gradient yet
    for name in ("module.0.log_std", "module.0.controller.weights.2", "module.0.controller.biases.2"):
        gradient = gradients[name]
        assert gradient is not None
        assert gradient.isfinite().all()
        assert gradient.any()


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan")])
def test_a_standard_deviation_that_is_none_is_refused(std):
    with pytest.raises(ValueError, match="std must be positive"):
        policy(std=std)


@pytest.mark.parametrize("high", [torch.inf, None])
def test_an_action_without_bounds_is_refused(high):
    spec = Unbounded((1,)) if high is None else Bounded(-1.0, torch.tensor([high]), shape=(1,))
    with pytest.raises(ValueError, match="must be bounded on both sides"):
        gaussian_policy(LinearController(4, 1), spec)
