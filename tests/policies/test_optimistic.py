"""Thompson sampling and upper confidence: what they choose, for how long, and for whom."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import ExplorationType, StepCounter, TransformedEnv, set_exploration_type

import envs
from torch_gprl.critics import GPActionValue
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.policies import ThompsonSampling, UpperConfidence

LEARNERS, ENVS, STATES = 2, 4, 2


def maximiser(actions: int = 1, learners: int = LEARNERS, candidates: int = 41) -> ActionMaximiser:
    low, high = -torch.ones(actions), 2 * torch.ones(actions)
    kernel = SquaredExponential(STATES + actions, 0.7, batch_shape=(learners,))
    gp = SparseOnlineGP(kernel, 30, 1e-2)
    critic = GPActionValue(gp, action_low=low, action_high=high)
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(20, STATES + actions, generator=generator).expand(learners, -1, -1)
    gp.update(inputs, torch.randn(20, generator=generator).expand(learners, 20))
    return ActionMaximiser(critic, low, high, candidates)


def states(step: int = 0, learners: int = LEARNERS) -> TensorDict:
    observation = torch.linspace(-1, 1, STATES).expand(learners, ENVS, STATES)
    count = torch.full((learners, ENVS, 1), step)
    return TensorDict({"observation": observation, "step_count": count}, (learners, ENVS))


def brute_force(opinion, observation: Tensor) -> Tensor:
    """The best action of one dimension on a fine grid."""
    fine = torch.linspace(-1, 2, 3001, dtype=torch.float64).reshape(-1, 1)
    value = opinion(observation, fine.expand(*observation.shape[:-1], -1, -1))
    return fine[value.argmax(-1)]


def test_an_episode_has_one_function_and_the_next_one_another():
    policy = ThompsonSampling(maximiser(), seed=3, learners=range(LEARNERS))
    first = policy(states(0))["action"]
    for step in range(1, 4):
        torch.testing.assert_close(policy(states(step))["action"], first)
    mixed = states(4)
    mixed["step_count"][:, 0] = 0
    later = policy(mixed)["action"]
    torch.testing.assert_close(later[:, 1:], first[:, 1:])
    assert (later[:, 0] != first[:, 0]).all()
    assert len(first.flatten().unique()) > ENVS  # each environment has a function of its own


def test_actions_maximise_the_function_of_the_episode():
    policy = ThompsonSampling(maximiser(), seed=3, learners=range(LEARNERS))
    data = policy(states(0))
    expected = brute_force(policy.opinion, data["observation"])
    assert (data["action"] - expected).abs().max() < 0.02


def test_actions_have_the_probability_of_being_best():
    policy = ThompsonSampling(maximiser(learners=1), seed=3, learners=[0])
    box, gp = policy.maximiser, policy.maximiser.critic.gp
    observation = torch.linspace(-1, 1, STATES).expand(1, 1000, STATES)
    count = torch.zeros(1, 1000, 1, dtype=torch.long)
    episodes = TensorDict({"observation": observation, "step_count": count}, (1, 1000))
    actions = policy(episodes)["action"].flatten()
    inputs = box.critic.inputs(observation[:, :41], box.candidates.expand(1, -1, -1))
    best = box.candidates[gp.joint(inputs).sample((5_000,)).argmax(-1)].flatten()
    edges = torch.tensor([-1.01, -0.5, 0.0, 0.5, 1.0, 1.5, 2.01])
    shares = [torch.histogram(sample.float(), edges).hist / len(sample) for sample in (actions, best)]
    # six standard errors of the share among 1,000, and what 128 frequencies leave of the prior
    assert (shares[0] - shares[1]).abs().max() < 6 * 0.5 / 1000**0.5 + 0.05


def test_more_data_settle_the_function():
    policy = ThompsonSampling(maximiser(), seed=3, learners=range(LEARNERS))
    box = policy.maximiser
    fine = torch.linspace(-1, 2, 200).reshape(1, -1, 1).expand(LEARNERS, -1, -1)
    observation = states()["observation"][:, :1].expand(-1, 200, -1)
    target = -(fine - 0.7).square().squeeze(-1)
    for _ in range(20):
        box.critic.gp.update(box.critic.inputs(observation, fine), target)
    assert (policy(states(0))["action"] - 0.7).abs().max() < 0.2


@pytest.mark.parametrize("actions", [1, 3])
def test_upper_confidence_maximises_mean_and_deviations(actions):
    box = maximiser(actions)
    policy = UpperConfidence(box, optimism=2.0)
    data = policy(states())
    posterior = box.critic.value(data["observation"], data["action"])
    upper = posterior.mean + 2 * posterior.variance.sqrt()
    rival = -1 + 3 * torch.rand(LEARNERS, ENVS, 500, actions)
    spread = data["observation"].unsqueeze(-2).expand(-1, -1, 500, -1)
    others = box.critic.value(spread, rival)
    best = (others.mean + 2 * others.variance.sqrt()).amax(-1)
    assert (upper > best - 0.02 * best.abs()).all()
    assert ((data["action"] >= -1) & (data["action"] <= 2)).all()


def test_without_optimism_upper_confidence_is_greedy():
    box = maximiser()
    found = UpperConfidence(box, optimism=0.0)(states())["action"]
    assert (found - box(states()["observation"]).action).abs().max() < 0.01


@pytest.mark.parametrize("kind", ["thompson", "upper"])
def test_without_exploration_the_action_is_greedy(kind):
    box = maximiser()
    policy = ThompsonSampling(box, learners=range(LEARNERS)) if kind == "thompson" else UpperConfidence(box)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = policy(states())
    torch.testing.assert_close(data["action"].double(), box(data["observation"]).action, rtol=1e-6, atol=1e-6)


def test_what_a_learner_does_does_not_depend_on_the_others():
    together = ThompsonSampling(maximiser(), seed=3, learners=range(LEARNERS))
    alone = ThompsonSampling(maximiser(learners=1), seed=3, learners=[1])
    for step in (0, 1, 2):
        data = states(step)
        data["step_count"][0, :2] = 0  # episodes of the other learner begin
        expected = together(data)["action"][1:2]
        torch.testing.assert_close(alone(states(step, learners=1))["action"], expected)


@pytest.mark.parametrize("kind", ["thompson", "upper"])
def test_it_drives_an_environment(kind):
    env = envs.make("pendulum-explore", learners=LEARNERS, num_envs=3, threads=1)
    low, high = (bound.reshape(-1)[:1] for bound in (env.action_spec.space.low, env.action_spec.space.high))
    kernel = SquaredExponential(4, batch_shape=(LEARNERS,))
    critic = GPActionValue(SparseOnlineGP(kernel, 20), action_low=low, action_high=high)
    box = ActionMaximiser(critic, low, high)
    policy = ThompsonSampling(box, learners=range(LEARNERS)) if kind == "thompson" else UpperConfidence(box)
    rollout = TransformedEnv(env, StepCounter()).rollout(10, policy)
    assert rollout["action"].dtype == rollout["observation"].dtype
    assert rollout["action"].isfinite().all()


def test_pessimism_is_refused():
    with pytest.raises(ValueError, match="optimism must be at least 0"):
        UpperConfidence(maximiser(), optimism=-1.0)
