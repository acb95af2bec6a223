"""What comes in: data are cast to the model's dtype, and bad data change nothing."""

import copy

import jaxtyping
import pytest
import torch

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential


def process() -> SparseOnlineGP:
    return SparseOnlineGP(SquaredExponential(2), 60, 0.2).requires_grad_(False)


def sample(count: int):
    inputs = torch.randn(count, 2, dtype=torch.float64)
    return inputs, inputs.sin().sum(-1)


def test_float32_data_are_cast_at_the_door():
    inputs, targets = (tensor.float() for tensor in sample(30))
    single, double = process(), process()
    single.update(inputs, targets)
    double.update(inputs.double(), targets.double())
    assert single.posterior(inputs).mean.dtype == torch.float64
    assert all(map(torch.equal, single.posterior(inputs), double.posterior(inputs.double())))


@pytest.mark.parametrize(
    ("inputs", "targets", "message"),
    [
        (torch.zeros(5, 3), torch.zeros(5), r"inputs must be .* 2\], got \(5, 3\)"),
        (torch.zeros(2), torch.zeros(()), "single point"),
        (torch.zeros(5, 2), torch.zeros(4), r"targets must be \(5,\)"),
        (torch.zeros(5, 2), torch.tensor([0, 0, torch.nan, 0, 0]), r"targets .* nan at index \[2\]"),
        (torch.full((5, 2), torch.inf), torch.zeros(5), "inputs must be finite: 10 of 10"),
    ],
)
def test_bad_data_are_turned_away_and_leave_the_state_unchanged(inputs, targets, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    gp = process()
    gp.update(*sample(10), stamp=3)
    before = copy.deepcopy(gp.state_dict())
    with pytest.raises(ValueError, match=message):
        gp.update(inputs, targets, stamp=4)
    assert all(torch.equal(before[key], tensor) for key, tensor in gp.state_dict().items())


@pytest.mark.parametrize(
    "points", [torch.zeros(3), torch.zeros(4, 3), torch.zeros(2, 5, 2)], ids=["one point", "width", "batch"]
)
def test_points_of_the_wrong_shape_get_no_prediction(points, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match="inputs must be"):
        process().posterior(points)


def test_a_discount_of_the_wrong_shape_is_refused_before_anything_is_learned(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    gp, (inputs, targets) = process(), sample(5)
    with pytest.raises(ValueError, match=r"discount must be a number or \(5,\), one per input, got \(4,\)"):
        gp.update(inputs, targets, stamp=4, next_inputs=inputs, discount=torch.full((4,), 0.9))
    assert int(gp.size) == int(gp.clock) == 0
