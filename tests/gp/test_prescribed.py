"""A prescribed basis: what joins it, and all data at once against the stream."""

import torch

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.gp.prescribed import LEAST_DISTANCE, adopt_basis, observe_anew
from torch_gprl.kernels import Matern

LENGTHSCALE = torch.tensor([0.5, 2.0], dtype=torch.float64)


def process(budget: int = 12, noise: float = 0.1) -> SparseOnlineGP:
    kernel = Matern(2, LENGTHSCALE, batch_shape=(2,), smoothness=2.5)
    return SparseOnlineGP(kernel, budget, noise, novelty_threshold=1e9, projection="dtc", overshoot=1)


def test_near_duplicates_do_not_join_the_basis():
    """Three places, each visited ten times within a tenth of the least distance."""
    places = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 3.0]], dtype=torch.float64).repeat(10, 1)
    jitter = 0.1 * LEAST_DISTANCE * LENGTHSCALE * torch.rand(2, 30, 2, dtype=torch.float64)
    gp = process()
    adopt_basis(gp, places + jitter)
    assert gp.size.tolist() == [3, 3]
    torch.testing.assert_close(gp.basis[0, :3], places[:3], atol=0.05, rtol=0)


def test_data_given_at_once_leave_what_the_stream_leaves():
    gp, stream = process(), process()
    inputs, following = torch.randn(2, 2, 50, 2, dtype=torch.float64).unbind(0)
    targets, rate = torch.randn(2, 50, dtype=torch.float64), 0.9
    for each in (gp, stream):
        adopt_basis(each, inputs)
    rows = gp.budget
    basis = gp.basis[:, :rows]
    observe_anew(gp, gp.kernel(inputs, basis) - rate * gp.kernel(following, basis), targets)
    stream.update(inputs, targets, next_inputs=following, discount=rate)
    torch.testing.assert_close(gp.precision, stream.precision)
    torch.testing.assert_close(gp.information, stream.information)
    torch.testing.assert_close(gp.log_marginal_likelihood(), stream.log_marginal_likelihood())
    new = torch.randn(2, 9, 2, dtype=torch.float64)
    for one, other in zip(gp.posterior(new), stream.posterior(new), strict=True):
        torch.testing.assert_close(one, other)


def test_data_given_anew_replace_those_before():
    gp = process()
    inputs = torch.randn(2, 30, 2, dtype=torch.float64)
    adopt_basis(gp, inputs)
    design = gp.kernel(inputs, gp.basis[:, : gp.budget])
    targets = torch.randn(2, 30, dtype=torch.float64)
    observe_anew(gp, design, targets)
    once = gp.posterior(inputs)
    observe_anew(gp, 3 * design, targets + 5)
    observe_anew(gp, design, targets)
    for one, other in zip(once, gp.posterior(inputs), strict=True):
        torch.testing.assert_close(one, other)
