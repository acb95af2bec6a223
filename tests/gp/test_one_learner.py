"""The short way of one learner: the numbers of the way of many, in any block, order and projection."""

import pytest
import torch

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import Kernel, Linear, Matern, SquaredExponential

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


@pytest.mark.parametrize("kernel", [SquaredExponential(2, 0.5), Matern(2, 0.5, smoothness=0.5), Linear(2)])
@pytest.mark.parametrize("shape", [(), (1,)])
def test_one_point_is_read_as_among_many(kernel: Kernel, shape: tuple[int, ...]):
    gp = SparseOnlineGP(kernel, 20, 0.05, batch_shape=shape)
    inputs = 3 * torch.rand(60, 2, dtype=F64)
    with torch.no_grad():
        for known in (0, 1, 30, 31):  # nothing, one point, a block, and one point more
            gp.update(inputs[:known], inputs[:known].sum(-1)) if known else None
            together = gp.posterior(inputs)
            for index in (3, 40):
                alone = gp.posterior(inputs[index : index + 1])
                for one, all_ in zip(alone, together, strict=True):
                    assert one.shape == (*shape, 1)
                    torch.testing.assert_close(one, all_[..., index : index + 1])


def test_one_point_is_read_from_the_present_kernel_state_and_precision():
    inputs = 3 * torch.rand(30, 2, dtype=F64)
    one = inputs[4:5]
    gp, other = (SparseOnlineGP(SquaredExponential(2, 0.5), 20, 0.05).requires_grad_(False) for _ in "ab")
    gp.update(inputs, inputs.sum(-1))
    before = gp(one)
    gp.kernel.lengthscale = 1.5
    torch.testing.assert_close(gp(one)[1], gp(inputs)[1][4:5])
    assert not torch.equal(gp(one)[1], before[1])
    other.load_state_dict(gp.state_dict())
    assert torch.equal(other(one)[0], gp(one)[0])
    gp.forget()
    assert gp(one)[0] == 0
    assert gp(one)[1] == gp.kernel.diag(one)


def test_one_point_is_learned_and_read_in_single_precision():
    with pytest.warns(UserWarning, match="float32"):
        gp = SparseOnlineGP(SquaredExponential(2, 0.5).float(), 20, 0.05)
    inputs = 3 * torch.rand(30, 2, dtype=F64)
    with torch.no_grad():
        for point in inputs.split(1):
            gp.update(point, point.sum(-1))
        mean, variance = gp(inputs[-1:])
        assert mean.dtype == variance.dtype == torch.float32
        torch.testing.assert_close(mean, gp(inputs)[0][-1:], rtol=1e-4, atol=1e-4)


def test_the_slope_at_one_point_is_that_among_many():
    gp = SparseOnlineGP(SquaredExponential(2, 0.5), 20, 0.05)
    inputs = 3 * torch.rand(30, 2, dtype=F64)
    gp.update(inputs, inputs.sum(-1))
    slopes = [
        torch.autograd.functional.jacobian(lambda x: sum(part.sum() for part in gp(x)), x)
        for x in (inputs, inputs[7:8])
    ]
    torch.testing.assert_close(slopes[0][7:8], slopes[1])
    assert slopes[1].abs().min() > 0
