"""Fitting hyper-parameters: what is fitted is likelier, predicts no worse, and is kept learner by learner."""

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from torch_gprl.gp import ExactGP, SparseOnlineGP, fit_hyperparameters
from torch_gprl.kernels import SquaredExponential


def drawn(count: int, lengthscale: tuple[float, float], noise: float) -> tuple[Tensor, Tensor]:
    """Points in a square and a draw of the Gaussian process with outputscale 2 there, with noise."""
    inputs = 6 * torch.rand(count, 2, dtype=torch.float64) - 3
    with torch.no_grad():
        covariance = SquaredExponential(2, lengthscale, 2.0)(inputs, inputs)
    noisy = covariance + noise * torch.eye(count, dtype=torch.float64)
    return inputs, MultivariateNormal(torch.zeros(count, dtype=torch.float64), noisy).sample()


def held_out_density(gp: SparseOnlineGP, inputs: Tensor, targets: Tensor) -> Tensor:
    """Mean log density of every fourth point under a dense process on the other three."""
    judged = torch.arange(inputs.shape[-2]) % 4 == 3
    exact = ExactGP(gp.kernel, gp.noise_variance.detach())
    exact.fit(inputs[..., ~judged, :], targets[..., ~judged])
    with torch.no_grad():
        mean, variance = exact.posterior(inputs[..., judged, :]).predictive(gp.noise_variance.unsqueeze(-1))
    return torch.distributions.Normal(mean, variance.sqrt()).log_prob(targets[..., judged]).mean(-1)


def test_the_parameters_of_data_drawn_from_a_process_are_found_again():
    # 200 points fix the logarithms of length scales and noise to about 0.1: bounds at five times that
    inputs, targets = drawn(200, (0.7, 2.0), 0.05)
    gp = SparseOnlineGP(SquaredExponential(2), 50, noise_variance=0.5)
    assert fit_hyperparameters(gp, inputs, targets, steps=150)
    found = torch.cat([gp.kernel.lengthscale, gp.noise_variance[None]]).detach()
    expected = torch.tensor([0.7, 2.0, 0.05], dtype=torch.float64)
    assert ((found / expected).log().abs() < 0.5).all(), found


def test_a_fit_raises_the_density_of_held_out_data_or_keeps_the_parameters():
    good, bad = drawn(80, (1.0, 1.0), 0.01), drawn(80, (1.0, 1.0), 0.01)
    bad[1][3::4] *= -1  # the judges of the second learner contradict what it is fitted to
    inputs, targets = torch.stack([good[0], bad[0]]), torch.stack([good[1], bad[1]])
    gp = SparseOnlineGP(SquaredExponential(2, 3.0, batch_shape=(2,)), 50, noise_variance=1.0)
    old = {name: parameter.detach().clone() for name, parameter in gp.named_parameters()}
    before = held_out_density(gp, inputs, targets)
    accepted = fit_hyperparameters(gp, inputs, targets)
    after = held_out_density(gp, inputs, targets)
    assert accepted.tolist() == [True, False]
    assert after[0] > before[0] + 0.1
    assert after[1] == before[1]
    for name, parameter in gp.named_parameters():
        assert torch.equal(parameter[1], old[name][1])
        assert not torch.equal(parameter[0], old[name][0])


def test_the_fit_of_a_learner_does_not_depend_on_the_others():
    first, second = drawn(60, (0.7, 2.0), 0.05), drawn(60, (2.0, 0.7), 0.2)
    both = SparseOnlineGP(SquaredExponential(2, batch_shape=(2,)), 50, noise_variance=0.3)
    fit_hyperparameters(both, *(torch.stack(pair) for pair in zip(first, second, strict=True)), steps=20)
    for learner, data in enumerate((first, second)):
        single = SparseOnlineGP(SquaredExponential(2), 50, noise_variance=0.3)
        fit_hyperparameters(single, *data, steps=20)
        torch.testing.assert_close(both.kernel.lengthscale[learner], single.kernel.lengthscale)
        torch.testing.assert_close(both.noise_variance[learner], single.noise_variance)


@pytest.mark.parametrize("floor", [1e-4, 1e-2])
def test_the_noise_does_not_fall_below_its_floor(floor):
    inputs = torch.linspace(-3, 3, 60, dtype=torch.float64).unsqueeze(-1)
    gp = SparseOnlineGP(SquaredExponential(1), 50, noise_variance=0.1)
    assert fit_hyperparameters(gp, inputs, inputs.sin().squeeze(-1), steps=200, noise_floor=floor)
    assert gp.noise_variance.item() == pytest.approx(floor)  # noiseless data ask for less


def test_what_was_learned_is_seen_through_the_new_kernel():
    inputs, targets = drawn(60, (0.7, 2.0), 0.05)
    gp = SparseOnlineGP(SquaredExponential(2), 100, noise_variance=0.05, novelty_threshold=0.0)
    gp.update(inputs, targets)
    assert fit_hyperparameters(gp, inputs, targets, steps=30)
    # nothing was projected, so the pseudo-likelihood is that of the data under the noise of the time
    exact = ExactGP(gp.kernel, 0.05).fit(inputs, targets)
    points = drawn(20, (1.0, 1.0), 1.0)[0]
    with torch.no_grad():
        for mine, theirs in zip(gp.posterior(points), exact.posterior(points), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6)


def test_more_steps_climb_further():
    inputs, targets = drawn(80, (0.7, 2.0), 0.05)
    likelihoods = []
    for steps in (0, 5, 50):
        gp = SparseOnlineGP(SquaredExponential(2, 4.0), 50, noise_variance=0.5)
        fit_hyperparameters(gp, inputs, targets, steps=steps)
        exact = ExactGP(gp.kernel, gp.noise_variance.detach()).fit(inputs, targets)
        likelihoods.append(exact.log_marginal_likelihood().item())
    assert likelihoods[0] < likelihoods[1] < likelihoods[2]


@pytest.mark.parametrize(
    ("inputs", "targets", "message"),
    [
        (torch.zeros(7, 2), torch.zeros(7), "at least 8 points, got 7"),
        (torch.zeros(20, 2), torch.full((20,), torch.nan), "targets must be finite"),
        (torch.zeros(20, 3), torch.zeros(20), "inputs must be"),
    ],
)
def test_bad_data_are_refused_and_change_nothing(inputs, targets, message):
    gp = SparseOnlineGP(SquaredExponential(2), 50)
    before = {name: parameter.detach().clone() for name, parameter in gp.named_parameters()}
    with pytest.raises(ValueError, match=message):
        fit_hyperparameters(gp, inputs, targets)
    assert all(torch.equal(before[name], parameter) for name, parameter in gp.named_parameters())
