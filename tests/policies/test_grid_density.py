"""Densities on a grid: everything about them belongs to one piecewise linear function."""

import math

import pytest
import torch
from scipy import stats
from torch.distributions import kl_divergence

from torch_gprl.policies.grid_density import GridDensity

LOW, HIGH = torch.tensor([-2.0], dtype=torch.float64), torch.tensor([3.0], dtype=torch.float64)
FINE = torch.linspace(-2, 3, 200_001, dtype=torch.float64).unsqueeze(-1)


def density(points: int = 21, batch: tuple[int, ...] = (), spread: float = 2.0) -> GridDensity:
    return GridDensity(spread * torch.randn(*batch, points, dtype=torch.float64), LOW, HIGH)


def normal(points: int) -> GridDensity:
    grid = torch.linspace(-2, 3, points, dtype=torch.float64)
    return GridDensity(-0.5 * ((grid - 0.4) / 0.3) ** 2 + 700, LOW, HIGH)


def integral(values: torch.Tensor) -> torch.Tensor:
    return torch.trapezoid(values, FINE.squeeze(-1))


def test_a_constant_is_the_uniform_distribution():
    flat = GridDensity(torch.full((3, 11), 4.0, dtype=torch.float64), LOW, HIGH)
    quantiles = torch.linspace(0, 1, 7, dtype=torch.float64).reshape(7, 1, 1).expand(7, 3, 1)
    assert torch.allclose(flat.entropy(), torch.tensor(math.log(5.0), dtype=torch.float64))
    for got, expected in ((flat.mean, 0.5), (flat.variance, 25 / 12), (flat.log_prob(LOW).exp(), 0.2)):
        assert torch.allclose(got, torch.tensor(expected, dtype=torch.float64))
    samples = torch.stack([flat.icdf(u) for u in quantiles])
    assert torch.allclose(samples, LOW + 5 * quantiles)


def test_it_integrates_to_one_and_its_moments_are_those_of_its_density():
    p = density()
    mass = p.log_prob(FINE).exp()
    torch.testing.assert_close(integral(mass), torch.tensor(1.0, dtype=torch.float64), rtol=1e-8, atol=0)
    mean = integral(mass * FINE.squeeze(-1))
    torch.testing.assert_close(p.mean.squeeze(), mean, rtol=1e-7, atol=1e-9)
    spread = integral(mass * (FINE.squeeze(-1) - mean) ** 2)
    torch.testing.assert_close(p.variance.squeeze(), spread, rtol=1e-7, atol=0)


def test_entropy_and_divergence_are_those_of_its_density():
    p, q = density(spread=0.3), density(spread=0.3)
    log_p, log_q = p.log_prob(FINE), q.log_prob(FINE)
    # Simpson's rule where the logarithm changes by about 0.4 from point to point
    assert abs(p.entropy() + integral(log_p.exp() * log_p)) < 1e-3
    divergence = integral(log_p.exp() * (log_p - log_q))
    assert abs(kl_divergence(p, q) - divergence) < 0.01 * divergence


def test_the_inverse_undoes_the_distribution_function():
    p = density(batch=(4,))
    for share in (0.0, 1e-6, 0.2, 0.5, 0.9, 1.0):
        point = p.icdf(torch.full((4, 1), share, dtype=torch.float64))
        for learner in range(4):
            below = FINE[point[learner] >= FINE]
            one = GridDensity(p.log_density[learner], LOW, HIGH)
            mass = torch.trapezoid(one.log_prob(below.unsqueeze(-1)).exp(), below)
            assert abs(mass - share) < 1e-4


def test_a_fine_grid_is_the_density_itself():
    p, truth = normal(401), stats.norm(0.4, 0.3)
    at = torch.tensor([[-0.5], [0.4], [1.234]], dtype=torch.float64)
    assert torch.allclose(p.log_prob(at), torch.tensor(truth.logpdf(at.squeeze(-1))), atol=2e-3)
    assert abs(p.entropy() - truth.entropy()) < 1e-3
    assert abs(p.stddev - 0.3) < 1e-3
    assert abs(p.mode - 0.4) < 0.0125


def test_samples_follow_the_density():
    p = density(points=9)
    samples = p.sample((50_000,)).squeeze(-1)

    def distribution(x):
        return [float(integral(p.log_prob(FINE).exp() * (FINE.squeeze(-1) <= end))) for end in x]

    edges = torch.linspace(-2, 3, 26).tolist()
    observed = torch.histogram(samples, torch.tensor(edges, dtype=torch.float64)).hist.numpy()
    cumulative = torch.tensor(distribution(edges), dtype=torch.float64)
    expected = (cumulative[1:] - cumulative[:-1]).numpy()
    # one failure in 10⁴ seeds
    assert stats.chisquare(observed, expected / expected.sum() * 50_000).pvalue > 1e-4


def test_the_divergence_from_itself_is_zero_and_so_is_its_gradient():
    log_density = torch.randn(11, dtype=torch.float64, requires_grad=True)
    p = GridDensity(log_density, LOW, HIGH)
    divergence = kl_divergence(GridDensity(log_density.detach(), LOW, HIGH), p)
    assert abs(divergence) < 1e-12
    (gradient,) = torch.autograd.grad(divergence, log_density)
    assert gradient.abs().max() < 1e-12


def test_nothing_lies_outside():
    assert torch.isneginf(density().log_prob(torch.tensor([[-2.01], [3.01]], dtype=torch.float64))).all()


@pytest.mark.parametrize("height", [1.0, 1e4])
def test_one_peak_among_nothing_gets_all_samples(height):
    log_density = torch.full((11,), -height, dtype=torch.float64)
    log_density[3] = height
    p = GridDensity(log_density, LOW, HIGH)
    assert p.log_prob(p.mode).isfinite()
    if height > 1e3:
        assert ((p.sample((100,)) - p.mode).abs() <= p.spacing).all()
