"""The model of the steps: what it learned from little data does not stand in its way."""

import torch

from torch_gprl.critics import TransitionModel, Transitions


def towards_a_wall(steps, reach, seed):
    """A point whose second coordinate moves with the action, and jumps where the first is near 1."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([reach, 2.0], dtype=torch.float64)
    state = torch.rand(1, steps, 2, generator=generator, dtype=torch.float64) * size - torch.tensor(
        [0.0, 1.0]
    )
    action = 2 * torch.rand(1, steps, 1, generator=generator, dtype=torch.float64) - 1
    across, along = state.split(1, -1)
    jump = torch.exp(-((across - 1) / 0.1).square())
    following = torch.cat([across, along + 0.1 * action - jump], -1)
    nothing = torch.zeros(1, steps, dtype=torch.float64)
    return Transitions(state, action, nothing, following, nothing)


def error(model):
    data = towards_a_wall(200, 1.1, seed=99)
    predicted = model.predict(data.observation, data.action, doubt=False).observation
    return (predicted - data.following).square().mean().sqrt()


def test_who_has_not_seen_the_wall_at_first_learns_it_as_well_as_others():
    before = TransitionModel(1, 2, 1, budget=100)
    for steps in (40, 80):
        before.solve(towards_a_wall(steps, 0.7, seed=steps), fit=True)
    fresh = TransitionModel(1, 2, 1, budget=100)
    for model in (before, fresh):
        model.solve(towards_a_wall(160, 1.1, seed=20), fit=True)
    assert error(before) < 1.1 * error(fresh)


def test_predictions_leave_the_range_of_what_was_seen_no_farther_than_told():
    model, data = TransitionModel(1, 2, 1, budget=50), towards_a_wall(60, 0.7, seed=1)
    model.solve(data, fit=False)
    top = torch.cat([data.observation, data.following], 1)[..., 1].max()
    edge = torch.stack([torch.tensor(0.3).double(), top]).view(1, 1, 2)
    up = torch.ones(1, 1, 1, dtype=torch.float64)
    stopped, free = (model.predict(edge, up, margin=margin).observation[..., 1] for margin in (0.0, 1.0))
    assert stopped.item() == top.item()
    torch.testing.assert_close(free, edge[..., 1] + 0.1, rtol=0, atol=0.03)


def test_a_reward_that_was_met_a_few_times_is_remembered():
    """A narrow reward, three times in 500 steps through a wide square."""
    generator = torch.Generator().manual_seed(2)
    state = 4 * torch.rand(2, 500, 2, generator=generator, dtype=torch.float64) - 2
    action = 2 * torch.rand(2, 500, 1, generator=generator, dtype=torch.float64) - 1
    state[:, 100:400:100] = 0.1 * state[:, 100:400:100]
    reward = torch.exp(-state.square().sum(-1) / (2 * 0.15**2))
    model = TransitionModel(2, 2, 1, budget=100)
    model.solve(Transitions(state, action, reward, state, torch.zeros_like(reward)), fit=True)
    met = model.predict(state, action, doubt=False).reward[:, 100:400:100]
    # chosen evenly in time, data leave one of these rewards, of nearly 1, forgotten altogether
    torch.testing.assert_close(met, reward[:, 100:400:100], rtol=0, atol=0.4)
