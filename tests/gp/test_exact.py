"""The dense Gaussian process against scikit-learn, GPyTorch and its own formulas."""

import math

import gpytorch
import numpy as np
import pytest
import torch
from sklearn.datasets import load_diabetes
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process import kernels as sk
from torch import Tensor

from torch_gprl.gp import ExactGP, Posterior
from torch_gprl.kernels import Kernel, Matern, Periodic, SquaredExponential

NOISE = 0.3
LENGTHSCALE = 0.1  # the diabetes inputs have standard deviation 0.05


def diabetes() -> tuple[Tensor, Tensor, Tensor]:
    """Inputs and standardised targets of 400 patients, inputs of 42 others."""
    inputs, targets = load_diabetes(return_X_y=True)
    targets = (targets - targets.mean()) / targets.std()
    return torch.from_numpy(inputs[:400]), torch.from_numpy(targets[:400]), torch.from_numpy(inputs[400:])


def sample(*batch: int, count: int = 12) -> tuple[Tensor, Tensor]:
    inputs = torch.randn(*batch, count, 2, dtype=torch.float64)
    return inputs, inputs.sin().sum(-1) + 0.1 * torch.randn(*batch, count, dtype=torch.float64)


@pytest.mark.parametrize(
    ("kernel", "theirs"),
    [
        (SquaredExponential(10, LENGTHSCALE, 2.0), sk.RBF(LENGTHSCALE)),
        (Matern(10, LENGTHSCALE, 2.0, smoothness=1.5), sk.Matern(LENGTHSCALE, nu=1.5)),
    ],
    ids=["squared exponential", "matern"],
)
def test_agreement_with_scikit_learn_on_the_diabetes_data(kernel: Kernel, theirs: sk.Kernel):
    inputs, targets, points = diabetes()
    reference = GaussianProcessRegressor(2.0 * theirs, alpha=NOISE, optimizer=None)
    reference.fit(inputs.numpy(), targets.numpy())
    mean, covariance = reference.predict(points.numpy(), return_cov=True)
    gp = ExactGP(kernel, NOISE).fit(inputs, targets)
    with torch.no_grad():
        ours, joint = gp.posterior(points), gp.joint(points)
        likelihood = gp.log_marginal_likelihood().item()
    np.testing.assert_allclose(ours.mean, mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(ours.variance, covariance.diagonal(), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(joint.mean, mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(joint.covariance_matrix, covariance, rtol=1e-8, atol=1e-8)
    assert likelihood == pytest.approx(reference.log_marginal_likelihood_value_, rel=1e-10)


class GPyTorchReference(gpytorch.models.ExactGP):
    def __init__(self, inputs: Tensor, targets: Tensor) -> None:
        super().__init__(inputs, targets, gpytorch.likelihoods.GaussianLikelihood())
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=10))
        self.double()
        # as tensors: GPyTorch rounds Python numbers to single precision
        self.covar_module.outputscale = torch.tensor(2.0, dtype=torch.float64)
        self.covar_module.base_kernel.lengthscale = torch.tensor(LENGTHSCALE, dtype=torch.float64)
        self.likelihood.noise = torch.tensor(NOISE, dtype=torch.float64)

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def test_agreement_with_gpytorch_on_the_diabetes_data():
    inputs, targets, points = diabetes()
    reference = GPyTorchReference(inputs, targets)
    gp = ExactGP(SquaredExponential(10, LENGTHSCALE, 2.0), NOISE).fit(inputs, targets)
    with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
        likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(reference.likelihood, reference)
        theirs = likelihood(reference(inputs), targets) * len(targets)
        torch.testing.assert_close(gp.log_marginal_likelihood(), theirs, rtol=1e-8, atol=0)
        latent = reference.eval()(points)
        torch.testing.assert_close(gp.posterior(points).mean, latent.mean, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(gp.posterior(points).variance, latent.variance, rtol=1e-8, atol=1e-8)


def test_without_data_the_posterior_is_the_prior():
    gp, points = ExactGP(SquaredExponential(2, 0.7, 2.0, batch_shape=(3,))), sample()[0]
    mean, variance = gp.posterior(points)
    assert not mean.any()
    torch.testing.assert_close(variance, torch.full((3, 12), 2.0, dtype=torch.float64))
    torch.testing.assert_close(gp.joint(points).covariance_matrix, gp.kernel(points, points))
    assert torch.equal(gp.log_marginal_likelihood(), torch.zeros(3, dtype=torch.float64))


def test_each_learner_of_a_batch_is_a_gp_of_its_own():
    inputs, targets = sample(3)
    points = sample()[0]
    batch = ExactGP(Matern(2, torch.tensor([[0.5], [1.0], [2.0]]), batch_shape=(3,)), [0.1, 0.2, 0.3]).fit(
        inputs, targets
    )
    for learner, (lengthscale, noise) in enumerate([(0.5, 0.1), (1.0, 0.2), (2.0, 0.3)]):
        single = ExactGP(Matern(2, lengthscale), noise).fit(inputs[learner], targets[learner])
        for mine, theirs in zip(batch.posterior(points), single.posterior(points), strict=True):
            torch.testing.assert_close(mine[learner], theirs)
        torch.testing.assert_close(batch.log_marginal_likelihood()[learner], single.log_marginal_likelihood())


def test_repeats_of_one_input_average_and_shrink():
    targets = torch.tensor([1.0, 4.0, -2.0], dtype=torch.float64)
    gp = ExactGP(Matern(1, 1.0, 2.0), 0.5).fit(torch.zeros(3, 1).double(), targets)
    mean, variance = gp.posterior(torch.zeros(1, 1).double())
    assert mean.item() == pytest.approx(3.0 / (3 + 0.5 / 2.0))  # Σy/(n + σ²/A)
    assert variance.item() == pytest.approx(1 / (1 / 2.0 + 3 / 0.5))


def test_the_likelihood_is_the_density_of_the_targets():
    inputs, targets = sample()
    gp = ExactGP(SquaredExponential(2), NOISE).fit(inputs, targets)
    covariance = gp.kernel(inputs, inputs) + NOISE * torch.eye(12).double()
    density = torch.distributions.MultivariateNormal(torch.zeros(12).double(), covariance).log_prob(targets)
    torch.testing.assert_close(gp.log_marginal_likelihood(), density)


def test_the_likelihood_is_differentiable_in_kernel_and_noise():
    inputs, targets = sample()
    gp = ExactGP(Periodic(2, 0.9) * Matern(2), NOISE).fit(inputs, targets)
    gp.log_marginal_likelihood().backward()
    for parameter in gp.parameters():
        gradient = parameter.grad
        assert gradient is not None
        step = torch.full_like(parameter.data, 1e-5)
        ends = []
        for sign in (1, -1):
            parameter.data.add_(sign * step)
            ends.append(gp.log_marginal_likelihood().item())
            parameter.data.sub_(sign * step)
        assert gradient.sum().item() == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(
    "kernel", [SquaredExponential(2), Matern(2, smoothness=1.5), Matern(2, smoothness=2.5)]
)
def test_the_posterior_is_differentiable_in_its_inputs_also_at_the_data(kernel: Kernel):
    inputs, targets = sample()
    gp = ExactGP(kernel, NOISE).fit(inputs, targets)
    points = torch.cat([inputs[:2], sample()[0][:2]]).requires_grad_()
    assert torch.autograd.gradcheck(lambda points: tuple(gp.posterior(points)), points)


def test_draws_have_the_moments_of_the_joint_distribution():
    gp = ExactGP(SquaredExponential(2), NOISE).fit(*sample())
    points = sample()[0][:3]
    with torch.no_grad():
        joint, (mean, variance) = gp.joint(points), gp.posterior(points)
    count = 20_000
    draws = joint.sample((count,))
    # six standard errors: one failure in 10⁸ runs
    assert ((draws.mean(0) - mean).abs() < 6 * (variance / count).sqrt()).all()
    assert ((draws.var(0) - variance).abs() < 6 * variance * math.sqrt(2 / count)).all()


def test_a_fit_replaces_the_data_and_follows_the_dtype_of_the_model():
    inputs, targets = sample()
    gp = ExactGP(SquaredExponential(2), NOISE).fit(*sample()).fit(inputs.float(), targets.float())
    fresh = ExactGP(SquaredExponential(2), NOISE).fit(inputs.float().double(), targets.float().double())
    for mine, theirs in zip(gp.posterior(inputs), fresh.posterior(inputs), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_predictive_adds_the_noise_and_stddev_is_the_root():
    latent = Posterior(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 3.5]))
    noisy = latent.predictive(0.5)
    assert torch.equal(noisy.mean, latent.mean)
    torch.testing.assert_close(noisy.stddev, torch.tensor([1.0, 2.0]))
