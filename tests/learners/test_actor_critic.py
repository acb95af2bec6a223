"""The actor-critic: a solved control problem, learners that do not meet, resuming, refusals."""

import io
from typing import Any

import pytest
import torch
from scipy.linalg import solve_discrete_are
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, PendulumEnv

import envs
from torch_gprl.learners import ActorCritic, ActorCriticConfig
from torch_gprl.runs import evaluate


def pendulums(learners: int = 3, first_learner: int = 0) -> envs.BatchEnv:
    return envs.make(
        "pendulum-swingup",
        learners=learners,
        num_envs=2,
        seed=3,
        first_learner=first_learner,
        dtype=torch.float64,
        threads=1,
    )


def config(updates: int = 8, **numbers: Any) -> ActorCriticConfig:
    defaults = {"rollout_steps": 5, "first_frames": 30, "budget": 30, "fit_steps": 3}
    return ActorCriticConfig(total_frames=updates * 10, **(defaults | numbers))


def saved_and_loaded(state: object) -> Any:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def parameters(learner: ActorCritic) -> dict[str, Tensor]:
    return {name: parameter.detach() for name, parameter in learner.policy.named_parameters()}


# ---------------------------------------------------------------- what it finds

DECAY, PUSH, STATE_COST, ACTION_COST, DISCOUNT = 0.95, 0.5, 1.0, 0.5, 0.9


class Regulator(EnvBase):
    """s' = a s + b u from s uniform in [−1, 1], reward −(q s² + r u²), ten steps."""

    def __init__(self, learners: int) -> None:
        super().__init__(batch_size=torch.Size([learners, 1]))
        kind = {"dtype": torch.float64, "shape": (learners, 1, 1)}
        self.observation_spec = Composite(observation=Unbounded(**kind), shape=(learners, 1))
        self.action_spec = Bounded(-2.0, 2.0, **kind)
        self.reward_spec = Unbounded(**kind)
        flags = {name: Binary(1, shape=(learners, 1, 1), dtype=torch.bool) for name in ("done", "terminated")}
        self.done_spec = Composite(flags, shape=(learners, 1))

    def _set_seed(self, seed: int | None) -> None:
        self.steps = 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        self.steps = 0
        self.state = 2 * torch.rand(*self.batch_size, 1, dtype=torch.float64) - 1
        return TensorDict({"observation": self.state} | self._flags(), self.batch_size)

    def _flags(self) -> dict[str, Tensor]:
        ended = torch.full((*self.batch_size, 1), self.steps >= 10)
        return {"done": ended, "terminated": torch.zeros_like(ended)}

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].clamp(-2, 2)
        reward = -(STATE_COST * self.state.square() + ACTION_COST * action.square())
        self.state, self.steps = DECAY * self.state + PUSH * action, self.steps + 1
        return TensorDict({"observation": self.state, "reward": reward} | self._flags(), self.batch_size)


def test_a_linear_quadratic_problem_gives_the_riccati_gain():
    root = DISCOUNT**0.5  # a discounted problem is one of dynamics scaled by √γ
    a, b = root * DECAY, root * PUSH
    (cost,) = solve_discrete_are(*([[x]] for x in (a, b, STATE_COST, ACTION_COST))).flatten()
    gain = a * b * cost / (ACTION_COST + b * b * cost)
    learner = ActorCritic(Regulator(4), ActorCriticConfig(total_frames=200, discount=DISCOUNT, budget=100))
    for _ in learner.train():
        pass
    state = torch.linspace(-0.6, 0.6, 9, dtype=torch.float64).reshape(1, 9, 1).expand(4, 9, 1)
    action, _ = learner.policy.head.parameters_at(state)
    torch.testing.assert_close(action, -gain * state, atol=0.1, rtol=0)


@pytest.mark.slow
def test_a_pendulum_swings_up_within_eight_hundred_steps():
    """The median of five learners, from −1,400 without learning; −144 is the optimum."""
    env = envs.make("Pendulum-v1", learners=5, threads=1)
    learner = ActorCritic(env, ActorCriticConfig(total_frames=800))
    for _ in learner.train():
        pass
    starts = envs.make("Pendulum-v1", learners=5, num_envs=10, seed=1000, threads=1)
    assert evaluate(starts, learner.policy).mean(1).median() > -300


# ---------------------------------------------------------------- learners side by side


def test_a_learner_of_many_learns_what_it_would_alone():
    together = ActorCritic(pendulums(3), config())
    alone = ActorCritic(pendulums(1, first_learner=1), config(), first_learner=1)
    for many, single in zip(together.train(), alone.train(), strict=True):
        assert all(figure.shape == (3,) for figure in many.values())
        # batched and single matrix products differ in roundoff, which an ill-conditioned system amplifies
        torch.testing.assert_close(many["value"][1], single["value"][0], rtol=1e-5, atol=1e-5)
    assert int(together.critic.gp.size[1]) == 30  # it did learn
    for name, parameter in parameters(alone).items():
        torch.testing.assert_close(parameters(together)[name][1], parameter[0], rtol=1e-4, atol=1e-5)


def test_the_same_seed_gives_the_same_run_and_another_seed_another():
    runs = []
    for seed in (0, 0, 1):
        learner = ActorCritic(pendulums(1), config(), seed=seed)
        runs.append(torch.stack([figures["value"] for figures in learner.train()]))
    assert torch.equal(runs[0], runs[1])
    assert not torch.allclose(runs[0], runs[2])


def test_a_loaded_run_continues_bit_for_bit():
    whole = ActorCritic(pendulums(2), config())
    saved, expected = None, {}
    for figures in whole.train():
        expected = figures
        if whole.updates == 5:
            saved = saved_and_loaded(whole.state_dict())
    resumed = ActorCritic(pendulums(2), config(), seed=7)
    assert saved is not None
    resumed.load_state_dict(saved)
    assert resumed.updates == 5
    assert resumed.frames == 50
    *_, last = resumed.train()
    torch.testing.assert_close(last, expected, rtol=0, atol=0, equal_nan=True)
    for name, parameter in parameters(whole).items():
        assert torch.equal(parameters(resumed)[name], parameter)


# ---------------------------------------------------------------- refusals


def test_an_environment_without_learners_is_refused():
    with pytest.raises(ValueError, match=r"\[learners, environments\]"):
        ActorCritic(PendulumEnv(), config())


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [("discount", 1.0, "below 1"), ("budget", 0, "at least 1"), ("noise", 0.0, "positive")],
)
def test_numbers_out_of_range_are_refused(name, value, rule):
    with pytest.raises(ValueError, match=f"{name} must be .*{rule}, got {value}"):
        ActorCriticConfig(**{name: value})
