"""Several targets on one basis: the dense posterior where nothing is dropped, FITC where something is."""

import torch

from torch_gprl.gp import ExactGP, SparseRegression
from torch_gprl.kernels import Linear, SquaredExponential


def data(learners=2, points=30, targets=3):
    generator = torch.Generator().manual_seed(0)
    inputs = torch.rand(learners, points, 2, generator=generator, dtype=torch.float64) * 4
    values = torch.randn(learners, points, targets, generator=generator, dtype=torch.float64)
    return inputs, values, torch.tensor([0.1, 0.3], dtype=torch.float64)[:learners]


def test_on_all_inputs_it_is_the_dense_posterior_of_every_target():
    inputs, targets, noise = data()
    kernel = SquaredExponential(2) + Linear(2)
    regression = SparseRegression(kernel, inputs, inputs, targets, noise)
    elsewhere = inputs.flip(1)[:, :7] + 0.1
    mean, variance = regression.mean(elsewhere), regression.variance(elsewhere)
    for learner in range(2):
        for target in range(3):
            dense = ExactGP(kernel, noise_variance=float(noise[learner]))
            dense.fit(inputs[learner], targets[learner, :, target])
            expected = dense.posterior(elsewhere[learner])
            torch.testing.assert_close(mean[learner, :, target], expected.mean, rtol=0, atol=1e-8)
            torch.testing.assert_close(variance[learner], expected.variance, rtol=0, atol=1e-8)


def test_on_fewer_vectors_it_is_fitc():
    inputs, targets, noise = data()
    kernel, basis = SquaredExponential(2), data()[0][:, :8]
    regression = SparseRegression(kernel, basis, inputs, targets, noise)
    gram, cross = kernel(basis, basis), kernel(basis, inputs)
    novelty = 1 - (cross * torch.linalg.solve(gram, cross)).sum(-2)
    weighted = cross / (noise[:, None] + novelty)[:, None]
    expected = torch.linalg.solve(gram + weighted @ cross.mT, weighted @ targets)
    torch.testing.assert_close(regression.coefficients, expected, rtol=1e-7, atol=1e-8)
