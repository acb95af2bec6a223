"""Positive parameters: what is assigned is read back, and the parameter object survives."""

import pytest
import torch

from torch_gprl.kernels import Matern, SquaredExponential


def test_parameters_are_read_as_they_were_given():
    kernel = SquaredExponential(2, [0.5, 2.0], 3.0)
    torch.testing.assert_close(kernel.lengthscale, torch.tensor([0.5, 2.0], dtype=torch.float64))
    torch.testing.assert_close(kernel.outputscale, torch.tensor(3.0, dtype=torch.float64))


def test_assigning_changes_the_value_and_keeps_the_parameter_object():
    kernel = Matern(3, batch_shape=(2,))
    before = dict(kernel.named_parameters())
    kernel.lengthscale = torch.tensor([[1.0], [4.0]])
    kernel.outputscale = 7.0
    assert all(before[name] is parameter for name, parameter in kernel.named_parameters())
    torch.testing.assert_close(kernel.lengthscale[1], torch.full((3,), 4.0, dtype=torch.float64))
    torch.testing.assert_close(kernel.outputscale, torch.full((2,), 7.0, dtype=torch.float64))


def test_a_parameter_that_is_not_its_own_name_is_not_in_the_state():
    assert set(SquaredExponential(2).state_dict()) == {"log_lengthscale", "log_outputscale"}


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_values_that_are_not_positive_and_finite_are_refused(value: float):
    with pytest.raises(ValueError, match="outputscale must be positive and finite"):
        SquaredExponential(2, outputscale=value)
    kernel = SquaredExponential(2)
    with pytest.raises(ValueError, match="lengthscale must be positive and finite"):
        kernel.lengthscale = value
    assert torch.equal(kernel.lengthscale, torch.ones(2, dtype=torch.float64))


def test_a_shape_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"lengthscale must broadcast to \(2,\), got shape \(4, 2\)"):
        SquaredExponential(2, torch.ones(4, 2))


def test_the_value_is_differentiable_in_the_parameter():
    kernel = SquaredExponential(2, 2.0)
    kernel.lengthscale.sum().backward()
    torch.testing.assert_close(kernel.log_lengthscale.grad, kernel.lengthscale.detach())  # d exp = exp
