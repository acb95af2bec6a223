"""The short way of one learner: the numbers of the way of many, in any block, order and projection."""

import pytest
import torch

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import Matern, SquaredExponential

F64 = torch.float64
KERNELS = {"gaussian": SquaredExponential, "other": Matern}


@pytest.mark.parametrize("options", [{}, {"projection": "dtc"}, {"order": "arrival"}, {"overshoot": 1}])
@pytest.mark.parametrize("kernel", KERNELS)
def test_one_learner_learns_as_each_of_two_do(kernel: str, options: dict):
    budget, points = (160, 700) if not options else (12, 170)
    alone, single, pair = (
        SparseOnlineGP(KERNELS[kernel](2, 0.3, 1.5, shape), budget, 0.02, 0.1, shape, **options)
        for shape in ((), (1,), (2,))
    )
    inputs = 5 * torch.rand(points, 2, dtype=F64)
    targets = inputs.sin().sum(-1)
    for block in torch.arange(points).split((1, 1, 20, 1, points - 160, 100, 37)):
        for gp in (alone, single, pair):
            gp.update(inputs[block], targets[block], stamp=int(block[0]))
    assert budget <= int(alone.size) == int(single.size[0]) == int(pair.size[1])
    assert torch.equal(alone.basis, single.basis[0])
    torch.testing.assert_close(alone.basis, pair.basis[1])
    assert torch.equal(alone.stamps, single.stamps[0])
    for name in ("gram_factor", "precision", "information", "evidence_constant"):
        mine = getattr(alone, name)
        torch.testing.assert_close(mine, getattr(single, name)[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(mine, getattr(pair, name)[1], rtol=1e-7, atol=1e-7)


def test_the_mean_alone_is_that_of_the_posterior_as_the_process_learns():
    gp = SparseOnlineGP(SquaredExponential(2, 0.5), 20, 0.05)
    for _ in range(5):
        inputs = 3 * torch.rand(30, 2, dtype=F64)
        gp.update(inputs, inputs.sum(-1))
        torch.testing.assert_close(gp.mean(inputs), gp.posterior(inputs).mean)
