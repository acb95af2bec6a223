"""The neural state value: it learns returns, rescales without a jump, and keeps learners apart."""

import torch
from tensordict import TensorDict

from torch_gprl.learners.neural_value import NeuralTeacher, NeuralValue

LEARNERS, ENVS, STEPS = 3, 4, 50


def rollout(seed: int = 0) -> TensorDict:
    """Returns that are a smooth function of the state, another one for each learner."""
    generator = torch.Generator().manual_seed(seed)
    observation = 3 + 2 * torch.randn(LEARNERS, ENVS, STEPS, 2, generator=generator)
    factor = torch.arange(1.0, LEARNERS + 1)[:, None, None]
    value = 100 + 10 * factor * (observation[..., 0] - 0.3 * observation[..., 1].square())
    data = {"observation": observation, "value_target": value.unsqueeze(-1)}
    return TensorDict(data, [LEARNERS, ENVS, STEPS])


def test_it_learns_returns_in_their_units():
    teacher = NeuralTeacher(NeuralValue(2, LEARNERS))
    for update in range(5):
        teacher.teach(rollout(update), update)
    new = rollout(99)
    truth = new["value_target"].squeeze(-1)
    error = teacher.critic.state_value(new["observation"]) - truth
    unexplained = error.square().mean((1, 2)) / truth.var((1, 2))
    assert (unexplained < 0.05).all()


def test_new_scales_change_no_value():
    teacher = NeuralTeacher(NeuralValue(2, LEARNERS))
    data = rollout()
    teacher.teach(data, 0)
    before = teacher.critic.state_value(data["observation"])
    teacher.critic.rescale_targets(7 * data["value_target"].flatten(1) - 40)
    assert (teacher.critic.target_scale > 50).all()
    torch.testing.assert_close(teacher.critic.state_value(data["observation"]), before, rtol=1e-4, atol=1e-3)


def test_a_learner_of_many_learns_what_it_would_alone():
    together = NeuralTeacher(NeuralValue(2, LEARNERS, seed=4))
    alone = NeuralTeacher(NeuralValue(2, 1, seed=4, first_learner=1))
    data = rollout()
    together.teach(data, 0)
    alone.teach(data[1:2], 0)
    expected = together.critic.state_value(data["observation"])[1]
    torch.testing.assert_close(
        alone.critic.state_value(data["observation"][1:2])[0], expected, rtol=1e-3, atol=1e-2
    )


def test_targets_without_spread_are_learned_as_they_are():
    teacher = NeuralTeacher(NeuralValue(2, LEARNERS))
    data = rollout()
    data["value_target"] = torch.full_like(data["value_target"], 5.0)
    teacher.teach(data, 0)
    value = teacher.critic.state_value(data["observation"])
    torch.testing.assert_close(value, torch.full_like(value, 5.0), rtol=0, atol=0.2)
