"""The episodic natural actor-critic: its episodes, its regression, and the natural gradient that it finds."""

import torch
from torch import nn

from torch_gprl.objectives import compatible_weights, episode_scores, split_episodes

LEARNERS, ENVS, STEPS = 2, 3, 7


def some_ends() -> torch.Tensor:
    """Learner 0: one episode in each environment. Learner 1: three in its first, two in its last."""
    done = torch.zeros(LEARNERS, ENVS, STEPS, dtype=torch.bool)
    done[..., -1] = True
    done[1, 0, [1, 4]] = True
    done[1, 2, 3] = True
    return done


def test_episodes_are_told_apart_and_discounted_from_their_start():
    episodes = split_episodes(some_ends(), 0.5)
    assert episodes.used.sum(1).tolist() == [3, 6]
    sums = episodes.sums(torch.ones(LEARNERS, ENVS, STEPS))
    geometric = [2 - 2 * 0.5**steps for steps in (7, 7, 7)]
    assert sorted(sums[0][episodes.used[0]].tolist()) == geometric
    lengths = sorted(split_episodes(some_ends()).sums(torch.ones(LEARNERS, ENVS, STEPS))[1].tolist())
    assert lengths[-6:] == [2, 2, 3, 3, 4, 7]


def test_scores_are_sums_of_the_gradients_of_each_step():
    weight = nn.Parameter(torch.randn(LEARNERS, 2, dtype=torch.float64))
    x = torch.randn(LEARNERS, ENVS, STEPS, 2, dtype=torch.float64)
    log_prob = (x * weight[:, None, None]).sum(-1).square()
    episodes = split_episodes(some_ends(), 0.9)
    found = episode_scores(log_prob, [weight], episodes)
    by_hand = 2 * (x * weight[:, None, None]).sum(-1, keepdim=True) * x  # of each step
    expected = torch.stack([episodes.sums(by_hand[..., column]) for column in range(2)], -1)
    torch.testing.assert_close(found, expected.detach())


def test_the_regression_is_least_squares_with_a_constant():
    scores = torch.randn(LEARNERS, 40, 5, dtype=torch.float64)
    returns = torch.randn(LEARNERS, 40, dtype=torch.float64)
    used = torch.rand(LEARNERS, 40) < 0.7
    found = compatible_weights(scores, returns, used)
    for learner in range(LEARNERS):
        rows = scores[learner][used[learner]]
        design = torch.cat([rows, torch.ones(len(rows), 1, dtype=torch.float64)], 1)
        expected = torch.linalg.lstsq(design, returns[learner][used[learner]].unsqueeze(-1)).solution
        torch.testing.assert_close(found[learner], expected[:-1, 0])


def test_with_few_episodes_the_shortest_solution_is_taken_and_with_one_none():
    scores = torch.randn(1, 3, 50, dtype=torch.float64)
    returns = torch.randn(1, 3, dtype=torch.float64)
    found = compatible_weights(scores, returns, torch.ones(1, 3, dtype=torch.bool))
    residual = returns - (scores @ found.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(residual, residual.mean().expand(1, 3))  # solved, up to J
    differences = scores[0, 1:] - scores[0, :1]
    along = torch.linalg.lstsq(differences.mT, found[0].unsqueeze(-1)).solution
    torch.testing.assert_close(differences.mT @ along, found.mT)  # nothing outside of what episodes span
    one = torch.tensor([[True, False, False]])
    assert (compatible_weights(scores, returns, one) == 0).all()


def test_it_finds_the_natural_gradient():
    # one step, a ~ N(θ, σ²), return −(a − 2)²: the natural gradient of J(θ) = −(θ − 2)² − σ² is −2σ²(θ − 2)
    theta, std, count = 0.5, 0.3, 1_000
    generator = torch.Generator().manual_seed(0)
    action = theta + std * torch.randn(1, count, 1, dtype=torch.float64, generator=generator)
    mean = nn.Parameter(torch.full((1, 1), theta, dtype=torch.float64))
    log_prob = -0.5 * ((action - mean.unsqueeze(-1)) / std).square()
    episodes = split_episodes(torch.ones(1, count, 1, dtype=torch.bool))
    scores = episode_scores(log_prob, [mean], episodes)
    returns = episodes.sums(-(action - 2).square())
    found = compatible_weights(scores, returns, episodes.used)
    # the spread of the return round the line is √2 σ², of the score 1/σ: standard error √2 σ³/√count = 1.2e-3
    torch.testing.assert_close(found[0, 0].item(), -2 * std**2 * (theta - 2), atol=6e-3, rtol=0)
