"""Dynamic programming as a learner: it learns from hundreds of steps, repeats itself and continues."""

import dataclasses

import pytest
import torch

import envs
from torch_gprl.learners import DynamicProgramming, DynamicProgrammingConfig
from torch_gprl.runs import evaluate

SMALL = DynamicProgrammingConfig(
    total_frames=125,
    model_budget=50,
    support=50,
    imagined=50,
    sweeps=5,
    backup_actions=5,
    acting_actions=9,
    rehearsal=2,
    ascents=1,
)


def make(learners=2, num_envs=1, seed=0, first_learner=0, config=SMALL, task="pendulum-swingup"):
    env = envs.make(task, learners=learners, num_envs=num_envs, seed=seed, first_learner=first_learner)
    return DynamicProgramming(env, config, seed=seed, first_learner=first_learner)


def returns(learner, updates=None):
    figures = [
        figure["model_error"] for _, figure in zip(range(updates or 99), learner.train(), strict=False)
    ]
    return torch.stack(figures)


def test_the_same_seed_gives_the_same_run():
    torch.testing.assert_close(returns(make()), returns(make()), rtol=0, atol=0, equal_nan=True)


def test_a_learner_among_others_is_that_learner_alone():
    both, second = returns(make(), 3), returns(make(learners=1, first_learner=1), 3)
    torch.testing.assert_close(both[:, 1:], second, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_a_saved_learner_goes_on_where_it_stood():
    whole = make()
    expected = returns(whole)
    first = make()
    for _ in zip(range(3), first.train(), strict=False):
        pass
    resumed = make()
    resumed.load_state_dict(first.state_dict())
    assert resumed.frames == 75
    torch.testing.assert_close(returns(resumed), expected[3:], rtol=0, atol=0)


def test_it_knows_the_reward_better_as_it_goes_on():
    error = returns(make(learners=3, config=dataclasses.replace(SMALL, total_frames=250)))
    assert (error[-1] < 0.2).all()  # of rewards between 0 and 1


def test_several_environments_of_a_learner_share_one_experience():
    learner = make(num_envs=3)
    for _ in learner.train():
        pass
    assert learner.experience.all()["reward"].shape == (2, 150)


def test_ends_of_the_task_are_learned():
    learner = make(task="cartpole-balance")
    for _ in learner.train():
        pass
    assert learner.experience.all()["terminated"].any()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("discount", 1.0),
        ("total_frames", 0),
        ("lengthscale", 0.0),
        ("hold", 0),
        ("smoothness", 1.0),
        ("std", -1.0),
    ],
)
def test_numbers_out_of_range_are_named(field, value):
    with pytest.raises(ValueError, match=rf"{field} must .*{value}"):
        DynamicProgrammingConfig(**{field: value})


@pytest.mark.slow
def test_the_pendulum_swings_up_after_four_hundred_steps():
    learner = make(learners=10, config=DynamicProgrammingConfig(total_frames=400), task="Pendulum-v1")
    for _ in learner.train():
        pass
    starts = envs.make("Pendulum-v1", learners=10, num_envs=20, seed=1000)
    reached = evaluate(starts, learner.policy).mean(1)
    # the optimum is near −145; one learner in ten may take longer
    assert (reached > -200).sum() >= 9, reached
