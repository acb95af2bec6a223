"""Q-learning: the tabular limit, ends of episodes, fixed points, learners that do not meet, resuming."""

import io
import itertools
import math
from collections.abc import Iterator
from typing import Any

import jaxtyping
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.critics import GPActionValue
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.learners import QLearning, QLearningConfig
from torch_gprl.learners.q_targets import FittedQ, OnlineQ, Regression

BOX = -torch.ones(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
STATES, DISCOUNT = 4, 0.9


def pendulums(learners: int = 2, first_learner: int = 0, task: str = "pendulum-swingup") -> envs.BatchEnv:
    return envs.make(
        task,
        learners=learners,
        num_envs=2,
        seed=3,
        first_learner=first_learner,
        dtype=torch.float64,
        threads=1,
    )


def config(updates: int = 4, **numbers: Any) -> QLearningConfig:
    defaults = {"rollout_steps": 20, "budget": 30, "sweeps": 5, "epsilon": 0.1}
    return QLearningConfig(total_frames=updates * 2 * 20, **(defaults | numbers))


def tensors(state: Any) -> Iterator[Tensor]:
    """All tensors of a nested state."""
    if isinstance(state, Tensor):
        yield state
    elif isinstance(state, dict | list | tuple):
        for part in state.values() if isinstance(state, dict) else state:
            yield from tensors(part)


def transitions(
    state: Tensor, action: Tensor, reward: Tensor, following: Tensor, **ends: Tensor
) -> TensorDict:
    """A rollout [1, 1, T] of a chain from columns [T]."""
    flags = {key: ends.get(key, torch.zeros_like(reward, dtype=torch.bool)) for key in ("done", "terminated")}
    flags["done"] = flags["done"] | flags["terminated"]
    columns = {
        "observation": state,
        "action": action,
        "next": {"observation": following, "reward": reward, **flags},
    }
    return TensorDict(columns, [len(reward)]).apply(
        lambda x: x.reshape(1, 1, -1, 1), batch_size=[1, 1, len(reward)]
    )


def critic(lengthscale: float, noise: float, budget: int = 40) -> GPActionValue:
    kernel = SquaredExponential(2, lengthscale, batch_shape=(1,))
    return GPActionValue(SparseOnlineGP(kernel, budget, noise, order="arrival"))


# ---------------------------------------------------------------- the tabular limit


def chain(steps: int) -> tuple[Tensor, ...]:
    """A random walk on a small decision process: states, actions in {−1, 0, 1}, rewards, successors."""
    generator = torch.Generator().manual_seed(0)
    successor = torch.randint(STATES, (STATES, 3), generator=generator)
    rewards = torch.rand(STATES, 3, generator=generator, dtype=torch.float64)
    state, action = torch.zeros(steps + 1, dtype=torch.long), torch.randint(3, (steps,), generator=generator)
    for step in range(steps):
        state[step + 1] = successor[state[step], action[step]]
    return state[:-1], action, rewards[state[:-1], action], state[1:]


def tabular(data: tuple[Tensor, ...], noise: float, rate: float) -> Tensor:
    """Tabular Q-learning with step sizes rate/(n + σ0²/A), point by point."""
    value, visits = torch.zeros(2, STATES, 3, dtype=torch.float64)
    for s, a, reward, following in zip(*data, strict=True):
        visits[s, a] += 1
        target = reward + DISCOUNT * value[following].max()
        value[s, a] += rate * (target - value[s, a]) / (visits[s, a] + noise)
    return value


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_far_apart_states_make_it_tabular_q_learning(rate):
    """Repeated visits give the step size 1/(n + σ0²/A) of tabular Q-learning."""
    data, noise = chain(100), 0.7
    process = critic(lengthscale=0.05, noise=noise)  # neighbours correlate by exp(−½/0.05²) = 1e-87
    teacher = OnlineQ(
        process,
        ActionMaximiser(process, *BOX, candidates=3, steps=0),
        QLearningConfig(targets="online", discount=DISCOUNT, learning_rate=rate),
    )
    process.gp.observations.fill_(1)  # the scaling stays 1, as a table has none
    for s, a, reward, following in zip(*data, strict=True):
        columns = (s.double()[None], a.double()[None] - 1, reward[None], following.double()[None])
        teacher.learn(transitions(*columns))
    pairs = torch.cartesian_prod(torch.arange(STATES), torch.arange(3)).double()
    learned = process.mean_value(pairs[None, :, :1], pairs[None, :, 1:] - 1)
    torch.testing.assert_close(learned.reshape(STATES, 3), tabular(data, noise, rate), atol=1e-8, rtol=0)


# ---------------------------------------------------------------- ends of episodes


def fitted(**numbers: Any) -> tuple[FittedQ, GPActionValue]:
    process = critic(lengthscale=0.5, noise=1e-3)
    numbers = {"total_frames": 100, "discount": DISCOUNT, "sweeps": 200, "noise": 1e-6} | numbers
    maximiser = ActionMaximiser(process, *BOX, candidates=3, steps=0)
    return FittedQ(process, maximiser, QLearningConfig(**numbers)), process


def walk(reward: list[float], **ends: list[bool]) -> TensorDict:
    """One state after the other, 0, 1, 2, ..., under the action 0."""
    count = len(reward)
    state = torch.arange(count + 1, dtype=torch.float64)
    flags = {key: torch.tensor(flag) for key, flag in ends.items()}
    action = torch.zeros(count, dtype=torch.float64)
    return transitions(state[:-1], action, torch.tensor(reward, dtype=torch.float64), state[1:], **flags)


@pytest.mark.parametrize("targets", ["fitted", "online"])
@pytest.mark.parametrize("end", ["terminated", "done"])
def test_time_limits_are_bootstrapped_and_terminal_states_are_not(targets, end):
    """The last of three states leads back to the first: its value continues unless it is terminal."""
    rollout = walk([1.0, 1.0, 1.0], **{end: [False, False, True]})
    rollout["next", "observation"][..., -1, :] = 0.0
    if targets == "fitted":
        teacher, process = fitted()
        teacher.learn(rollout)
    else:
        process = critic(lengthscale=0.05, noise=1e-6)
        process.gp.observations.fill_(1)
        maximiser = ActionMaximiser(process, *BOX, candidates=3, steps=0)
        numbers = QLearningConfig(targets="online", discount=DISCOUNT, horizon=1)
        teacher = OnlineQ(process, maximiser, numbers)
        for _ in range(3):
            teacher.learn(rollout)
    last = process.mean_value(rollout["observation"][:, 0], rollout["action"][:, 0])[0, -1]
    assert (last == pytest.approx(1.0, abs=0.02)) == (end == "terminated")


def test_online_targets_count_the_given_number_of_real_rewards():
    process = critic(lengthscale=0.05, noise=1e-9)
    process.gp.observations.fill_(1)
    teacher = OnlineQ(
        process,
        ActionMaximiser(process, *BOX, candidates=3, steps=0),
        QLearningConfig(targets="online", discount=DISCOUNT, horizon=3),
    )
    rollout = walk([1.0, 2.0, 3.0, 4.0])
    teacher.learn(rollout)
    values = process.mean_value(rollout["observation"][:, 0], rollout["action"][:, 0])[0]
    expected = [1 + 0.9 * 2 + 0.81 * 3, 2 + 0.9 * 3 + 0.81 * 4, 3 + 0.9 * 4, 4]  # the critic was empty
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64), atol=1e-6, rtol=0)


# ---------------------------------------------------------------- the fixed point


def test_fitted_values_satisfy_the_optimality_equation():
    """Every (state, action) pair of a small process: the fixed point is that of value iteration."""
    generator = torch.Generator().manual_seed(1)
    successor = torch.randint(STATES, (STATES, 3), generator=generator)
    rewards = torch.rand(STATES, 3, generator=generator, dtype=torch.float64)
    pairs = torch.cartesian_prod(torch.arange(STATES), torch.arange(3))
    state, action = pairs[:, 0], pairs[:, 1]
    teacher, process = fitted(lengthscale=0.02, action_lengthscale=0.1)
    with torch.no_grad():
        process.gp.kernel.lengthscale = 0.1  # of the scaled inputs: every pair is for itself
        process.gp.log_noise_variance.fill_(-18.0)
    teacher.learn(
        transitions(
            state.double(), action.double() - 1, rewards[state, action], successor[state, action].double()
        )
    )
    value = torch.zeros(STATES, 3, dtype=torch.float64)
    for _ in range(300):
        value = rewards + DISCOUNT * value.max(-1).values[successor]
    learned = process.mean_value(state.double()[None, :, None], action.double()[None, :, None] - 1)
    # the sweeps end when targets change by less than 1e-3 of their deviation: 1e-3 γ/(1 − γ) is left at most
    torch.testing.assert_close(learned.reshape(STATES, 3), value, atol=0.02 * float(value.std()), rtol=0)


def test_weights_are_a_linear_function_of_targets_on_a_fixed_basis():
    """The same as absorbing the targets, once the basis no longer grows."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(1, 60, 2, generator=generator, dtype=torch.float64)
    targets = torch.randn(1, 60, generator=generator, dtype=torch.float64)
    gp = SparseOnlineGP(SquaredExponential(2, 1.0, batch_shape=(1,)), 20, 0.1)
    gp.update(inputs, torch.zeros_like(targets))
    gp.novelty_threshold = math.inf
    gp.forget()
    gp.update(inputs, targets)
    torch.testing.assert_close(Regression(gp, inputs).alpha(targets), gp.alpha, rtol=1e-8, atol=1e-8)


def test_values_stay_within_what_rewards_can_add_up_to():
    teacher, process = fitted(lengthscale=5.0, optimism=4.0)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        rewards = torch.rand(20, generator=generator).double().tolist()
        teacher.learn(walk(rewards))
    data = teacher._remembered()
    target = teacher._first_targets(data)
    assert (target <= 1 / (1 - DISCOUNT)).all()
    assert (target >= 0).all()
    assert process.gp.observations == len(teacher.experience) == 80


@pytest.mark.parametrize("hindsight", [True, False])
def test_with_hindsight_no_target_is_below_what_the_episode_attained(hindsight):
    generator = torch.Generator().manual_seed(0)
    teacher, process = fitted(hindsight=hindsight, optimism=-1.0)
    with torch.no_grad():
        process.gp.log_noise_variance.fill_(0.0)  # a critic that believes little of what it is told
    teacher.learn(walk(torch.rand(12, generator=generator).double().tolist()))
    data = teacher._remembered()
    first = teacher._first_targets(data)
    target = teacher._iterate(data, first, process.inputs(data.observation, data.action))[0]
    attained = data.reward[0, :-1] + DISCOUNT * target[1:]
    assert (target[:-1] >= attained - 0.01).all() == hindsight


def test_transitions_of_different_environments_and_episodes_are_not_joined():
    one, other = walk([1.0, 2.0]), walk([3.0, 4.0], done=[True, False])
    teacher, _ = fitted()
    teacher.learn(torch.cat([one, other], 1))
    assert teacher._remembered().continues.tolist() == [[True, False, False, False]]


def test_optimism_values_the_unknown_above_what_was_seen():
    plain, hopeful = (fitted(optimism=optimism) for optimism in (0.0, 2.0))
    far = torch.full((1, 1, 1), 1e3, dtype=torch.float64)
    for teacher, _ in (plain, hopeful):
        teacher.learn(walk([0.0, 1.0, 0.5, 0.2, 0.9]))
    values = [process.mean_value(far, 0 * far).item() for _, process in (plain, hopeful)]
    assert values[1] > values[0] + 1.9 * hopeful[1].target_scale.item()


# ---------------------------------------------------------------- learners side by side


@pytest.mark.parametrize("targets", ["fitted", "online"])
def test_a_learner_of_many_learns_what_it_would_alone(targets):
    numbers = config(targets=targets)
    together = QLearning(pendulums(3), numbers)
    alone = QLearning(pendulums(1, first_learner=1), numbers, first_learner=1)
    for many, single in zip(together.train(), alone.train(), strict=True):
        assert all(figure.shape == (3,) for figure in many.values())
        for name, figure in many.items():
            # solving anew amplifies the roundoff by which batched and single matrix products differ
            torch.testing.assert_close(figure[1], single[name][0], rtol=1e-3, atol=1e-3, equal_nan=True)
    assert together.frames == alone.frames == 160


def test_the_same_seed_gives_the_same_run_and_another_seed_another():
    runs = []
    for seed in (0, 0, 1):
        learner = QLearning(pendulums(2), config(2), seed=seed)
        figures = list(learner.train())
        runs.append(list(tensors((figures, learner.teacher.critic.state_dict()))))
    for one, two in zip(runs[0], runs[1], strict=True):
        assert torch.equal(one.nan_to_num(), two.nan_to_num())
    assert not all(torch.equal(one, two) for one, two in zip(runs[0], runs[2], strict=True))


@pytest.mark.parametrize("targets", ["fitted", "online"])
def test_a_saved_run_goes_on_as_it_would_have(targets):
    learner = QLearning(pendulums(2), config(targets=targets))
    training = learner.train()
    list(itertools.islice(training, 2))
    training.close()
    file = io.BytesIO()
    torch.save(learner.state_dict(), file)
    file.seek(0)
    other = QLearning(pendulums(2), config(targets=targets), seed=9)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert other.updates == 2
    figures = [list(continued.train()) for continued in (learner, other)]
    assert len(figures[0]) == 2
    for one, two in zip(tensors(figures[0]), tensors(figures[1]), strict=True):
        assert torch.equal(one.nan_to_num(), two.nan_to_num())
    assert list(other.train()) == []


# ---------------------------------------------------------------- behaviour


def test_exploration_is_uniform_at_first_then_round_the_greedy_action_and_absent_when_asked():
    learner = QLearning(pendulums(2), config(epsilon=0.0, std=0.05))
    states = TensorDict({"observation": torch.randn(2, 500, 3, dtype=torch.float64)}, [2, 500])
    high = learner.maximiser.high
    first = learner.policy(states.clone())["action"] / high
    assert first.abs().max() <= 1
    # Kolmogorov's 99.99 % bound for 1,000 uniform numbers
    steps = torch.arange(1, 1001) / 1000
    assert ((first.flatten().sort().values + 1) / 2 - steps).abs().max() < 2.23 / 1000**0.5
    next(learner.train())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(states.clone())["action"]
        assert torch.equal(greedy, learner.policy(states.clone())["action"])
    strayed = learner.policy(states.clone())["action"]
    noise = ((strayed - greedy) / high)[strayed.abs() < high]  # what the box has not clipped
    assert 0.02 < noise.square().mean().sqrt() < 0.07  # half normal where the best action is a bound
    assert (strayed.abs() <= high).all()


def test_balancing_improves():
    env = envs.make("pendulum-balance", learners=4, num_envs=1, seed=0, threads=1)
    figures = list(QLearning(env, QLearningConfig(total_frames=250, budget=80, sweeps=15)).train())
    assert figures[-1]["return"].mean() > 50  # of 100 possible; a random policy gets about 13


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"total_frames": 0}, "total_frames must be at least 1, got 0"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"candidates": 2}, "candidates must be at least 3"),
        ({"discount": 1.0}, "discount must be at least 0 and below 1, got 1.0"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"std": -0.1}, "std must be at least 0"),
        ({"optimism": float("nan")}, "optimism must be finite"),
        ({"targets": "sarsa"}, "targets must be one of fitted, online, got 'sarsa'"),
    ],
)
def test_numbers_out_of_range_are_refused(numbers, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        QLearningConfig(**numbers)
