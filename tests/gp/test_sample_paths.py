"""Functions drawn from the posterior: their mean, their covariance, and that they are functions."""

import pytest
import torch

from torch_gprl.gp import PathSampler, SparseOnlineGP
from torch_gprl.kernels import Columns, Kernel, Matern, RationalQuadratic, SquaredExponential

LEARNERS, DIMS = 2, 2
KERNELS = {
    "squared exponential": lambda: SquaredExponential(DIMS, 0.8, 1.5, batch_shape=(LEARNERS,)),
    "Matérn 1/2": lambda: Matern(DIMS, 0.8, 1.5, batch_shape=(LEARNERS,), smoothness=0.5),
    "Matérn 3/2": lambda: Matern(DIMS, 0.8, 1.5, batch_shape=(LEARNERS,), smoothness=1.5),
    "product": lambda: (
        Columns(Matern(1, 0.8, 1.5, batch_shape=(LEARNERS,), smoothness=2.5), (1,), DIMS)
        * Columns(SquaredExponential(1, 0.6, batch_shape=(LEARNERS,)), (0,), DIMS)
    ),
    "Matérn 5/2": lambda: Matern(DIMS, 0.8, 1.5, batch_shape=(LEARNERS,), smoothness=2.5),
}


def taught(kernel: Kernel, points: int = 25, noise: float = 0.05) -> SparseOnlineGP:
    """A process whose second learner has seen half as much."""
    gp = SparseOnlineGP(kernel, 20, noise)
    mask = torch.ones(LEARNERS, points, dtype=torch.bool)
    mask[1, points // 2 :] = False
    gp.update(2 * torch.rand(LEARNERS, points, DIMS) - 1, torch.randn(LEARNERS, points), mask=mask)
    return gp


def sampler(gp: SparseOnlineGP, features: int) -> PathSampler:
    return PathSampler(gp, features, [torch.Generator().manual_seed(i) for i in range(LEARNERS)])


def drawn(gp: SparseOnlineGP, inputs: torch.Tensor, count: int, features: int = 500) -> torch.Tensor:
    """Values [learners, count, N] of many functions at the same inputs [learners, N, D]."""
    paths = sampler(gp, features)
    normal = torch.randn(LEARNERS, count, paths.random_numbers)
    spread = inputs.unsqueeze(1).expand(-1, count, -1, -1)
    return paths.values(paths.draw(normal), spread)


@pytest.mark.parametrize("name", KERNELS)
def test_mean_and_covariance_are_the_posteriors(name):
    gp = taught(KERNELS[name]())
    inputs = torch.tensor([[0.0, 0.0], [0.3, 0.1], [0.9, -0.8], [3.0, 3.0], [3.4, 3.0]]).expand(
        LEARNERS, -1, -1
    )
    values, joint = drawn(gp, inputs, 1000), gp.joint(inputs)
    # six standard errors of 1,000 functions, and what 500 frequencies leave of the prior's covariance
    error = 6 * 1.5 / 1000**0.5
    assert (values.mean(1) - joint.mean).abs().max() < 6 * (1.5 / 1000) ** 0.5
    covariance = (values - values.mean(1, keepdim=True)).mT @ (values - values.mean(1, keepdim=True)) / 1000
    assert (covariance - joint.covariance_matrix).abs().max() < error + 6 * 1.5 / 500**0.5


def test_without_data_a_function_is_one_of_the_prior():
    gp = SparseOnlineGP(KERNELS["squared exponential"](), 20)
    values = drawn(gp, torch.zeros(LEARNERS, 1, DIMS), 1000)
    assert (values.mean(1).abs() < 6 * (1.5 / 1000) ** 0.5).all()
    torch.testing.assert_close(values.var(1), torch.full((LEARNERS, 1), 1.5).double(), rtol=0.3, atol=0)


def test_with_exact_data_all_functions_pass_through_them():
    gp = SparseOnlineGP(KERNELS["squared exponential"](), 20, 1e-8, 1e-3)
    inputs, targets = torch.randn(LEARNERS, 6, DIMS), torch.randn(LEARNERS, 6).double()
    gp.update(inputs, targets)
    values = drawn(gp, inputs, 50, 200)
    assert (values - targets.unsqueeze(1)).abs().max() < 1e-2


def test_a_path_is_one_function_whatever_it_is_asked_beside():
    gp = taught(KERNELS["Matérn 3/2"]())
    paths = sampler(gp, 50)
    drawn = paths.draw(torch.randn(LEARNERS, 3, paths.random_numbers))
    inputs = torch.randn(LEARNERS, 3, 7, DIMS)
    together = paths.values(drawn, inputs)
    for point in range(7):
        alone = paths.values(drawn, inputs[:, :, point : point + 1])
        torch.testing.assert_close(together[:, :, point : point + 1], alone)


def test_a_learners_functions_do_not_depend_on_the_others():
    gp = taught(KERNELS["squared exponential"]())
    alone = SparseOnlineGP(SquaredExponential(DIMS, 0.8, 1.5, batch_shape=(1,)), 20, 0.05)
    state = {key: value[1:2] if value.ndim else value for key, value in gp.state_dict().items()}
    alone.load_state_dict(state)
    many, one = sampler(gp, 50), PathSampler(alone, 50, [torch.Generator().manual_seed(1)])
    normal = torch.randn(LEARNERS, 3, many.random_numbers)
    inputs = torch.randn(LEARNERS, 3, 4, DIMS)
    expected = many.values(many.draw(normal), inputs)[1:2]
    found = one.values(one.draw(normal[1:2]), inputs[1:2])
    torch.testing.assert_close(found, expected)


def test_a_kernel_of_unknown_spectrum_is_refused():
    gp = SparseOnlineGP(RationalQuadratic(DIMS, batch_shape=(LEARNERS,)), 20)
    with pytest.raises(
        TypeError, match="need SquaredExponential or Matern kernels, or products, got RationalQuadratic"
    ):
        sampler(gp, 10)
