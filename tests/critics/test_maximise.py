"""Maximisation over actions: it finds the maxima of known functions and never leaves the box."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torch_gprl.critics import GPActionValue
from torch_gprl.critics.maximise import ActionMaximiser, ascend, candidate_actions, factorises
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import Columns, Kernel, Matern, SquaredExponential

LEARNERS, STATES = 2, 12
Function = Callable[[Tensor, Tensor], Tensor]


def quadratic(state: Tensor, action: Tensor) -> Tensor:
    """Its maximum is 3, at a = 0.4 s in every dimension."""
    return 3 - (action - 0.4 * state[..., :1]).square().sum(-1)


def multimodal(state: Tensor, action: Tensor) -> Tensor:
    """Two bumps in the first dimension; the sign of the state says which one is higher."""
    bumps = [torch.exp(-8 * (action[..., 0] - place).square()) for place in (-0.6, 0.6)]
    return bumps[1] + bumps[0] + 0.3 * state[..., 0] * (bumps[1] - bumps[0])


def rising(state: Tensor, action: Tensor) -> Tensor:
    """Grows towards a corner of the box."""
    return action.sum(-1) + state[..., 0]


def fitted(
    function: Function, actions: int, kernel: Callable[..., Kernel] = SquaredExponential, points: int = 150
):
    """A critic that has learned the function on the box [−1, 1]^A."""
    generator = torch.Generator().manual_seed(0)
    data = 2 * torch.rand(LEARNERS, points, 1 + actions, generator=generator, dtype=torch.float64) - 1
    observation, action = data.split((1, actions), -1)
    target = function(observation, action).unsqueeze(-1)
    lengthscale = 0.7 if actions == 1 else 4.0  # standard deviations
    form = kernel(1 + actions, lengthscale, batch_shape=(LEARNERS,))
    process = SparseOnlineGP(form, points, 1e-6)
    critic = GPActionValue(process)
    critic.standardise(observation, action, target)
    process.update(critic.inputs(observation, action), critic.standard_targets(target))
    return critic


def box(actions: int) -> tuple[Tensor, Tensor]:
    high = torch.ones(actions, dtype=torch.float64)
    return -high, high


def some_states(count: int = STATES) -> Tensor:
    states = torch.linspace(-0.9, 0.9, count, dtype=torch.float64)
    return states.reshape(1, -1, 1).expand(LEARNERS, -1, -1)


@pytest.mark.parametrize("actions", [1, 3])
def test_the_peak_of_a_quadratic_is_found(actions):
    maximiser = ActionMaximiser(fitted(quadratic, actions), *box(actions), steps=12)
    found = maximiser(some_states())
    expected = (0.4 * some_states()).expand(-1, -1, actions)
    torch.testing.assert_close(found.action, expected, atol=0.02, rtol=0)
    torch.testing.assert_close(found.value, torch.full_like(found.value, 3.0), atol=0.02, rtol=0)


def test_the_higher_of_two_peaks_is_found():
    found = ActionMaximiser(fitted(multimodal, 1), *box(1))(some_states())
    clear = some_states()[..., 0].abs() > 0.3
    assert torch.equal(found.action[clear][:, 0].sign(), some_states()[..., 0][clear].sign())


def test_three_dimensions_agree_with_a_fine_grid():
    critic = fitted(multimodal, 3)
    found = ActionMaximiser(critic, *box(3), candidates=64, starts=4, steps=12)(some_states())
    fine = torch.linspace(-1, 1, 17, dtype=torch.float64)
    grid = torch.cartesian_prod(fine, fine, fine)
    pairs = (LEARNERS, STATES, len(grid))
    values = critic.mean_value(some_states().unsqueeze(-2).expand(*pairs, 1), grid.expand(*pairs, 3))
    regret = values.max(-1).values - found.value
    assert (regret < 0.05).all()  # no search of finite length finds each of many peaks
    assert (regret < 1e-3).double().mean() >= 0.8
    torch.testing.assert_close(critic.mean_value(some_states(), found.action), found.value)


@pytest.mark.parametrize("actions", [1, 3])
def test_a_maximum_on_the_boundary_is_found_and_the_box_never_left(actions):
    found = ActionMaximiser(fitted(rising, actions), *box(actions))(2 * some_states())
    assert (found.action.abs() <= 1).all()
    inside = some_states()[0, :, 0].abs() < 0.5  # where the fit knows the function
    torch.testing.assert_close(
        found.action[:, inside], torch.ones_like(found.action[:, inside]), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("kernel", [SquaredExponential, Matern])
def test_one_dimension_agrees_with_a_fine_grid(kernel):
    critic = fitted(multimodal, 1, kernel)
    found = ActionMaximiser(critic, *box(1))(some_states())
    fine = torch.linspace(-1, 1, 2001, dtype=torch.float64).unsqueeze(-1)
    pairs = (LEARNERS, STATES, len(fine))
    values = critic.mean_value(some_states().unsqueeze(-2).expand(*pairs, 1), fine.expand(*pairs, 1))
    best, index = values.max(-1)
    torch.testing.assert_close(found.value, best, atol=2e-3, rtol=0)
    # what it says of the value is the critic's own word on that action, up to the parabola's error
    torch.testing.assert_close(critic.mean_value(some_states(), found.action), found.value, atol=2e-3, rtol=0)
    close = (found.action - fine[index]).abs() < 0.02
    assert close.double().mean() > 0.9  # near a tie the other peak may win


def by_columns(dims: int, lengthscale: float, batch_shape: tuple[int, ...]) -> Kernel:
    """A Matérn kernel over states times one over actions."""
    over_states = Matern(1, lengthscale, batch_shape=batch_shape, smoothness=2.5)
    over_actions = SquaredExponential(dims - 1, lengthscale, 2.0, batch_shape)
    return Columns(over_states, (0,), dims) * Columns(over_actions, range(1, dims), dims)


def test_only_products_of_states_and_actions_factorise():
    assert factorises(SquaredExponential(3), 2)
    assert factorises(by_columns(3, 1.0, ()), 1)
    assert not factorises(by_columns(3, 1.0, ()), 2)  # its second factor covers a state and an action
    assert not factorises(Matern(3), 2)


@pytest.mark.parametrize("kernel", [SquaredExponential, by_columns])
def test_the_product_over_columns_equals_the_kernel_of_pairs(kernel):
    critic = fitted(quadratic, 3, kernel)
    maximiser = ActionMaximiser(critic, *box(3), candidates=5)
    pairs = (LEARNERS, STATES, len(maximiser.candidates))
    spread = some_states().unsqueeze(-2).expand(*pairs, 1)
    expected = critic.mean_value(spread, maximiser.candidates.expand(*pairs, 3))
    mean = maximiser.products(some_states()).mean(critic.gp.alpha)
    torch.testing.assert_close(
        critic.target_loc[:, None, None] + critic.target_scale[:, None, None] * mean,
        expected,
        atol=1e-9,
        rtol=1e-9,
    )


def test_memory_is_bounded_without_changing_the_answer(monkeypatch):
    maximiser = ActionMaximiser(fitted(quadratic, 1), *box(1))
    whole = maximiser(some_states())
    monkeypatch.setattr("torch_gprl.critics.maximise.CHUNK", 1000)
    for one, other in zip(maximiser(some_states()), whole, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("actions", [1, 3])
def test_a_given_action_is_taken_where_it_is_better(actions):
    critic = fitted(quadratic, actions)
    maximiser = ActionMaximiser(critic, *box(actions), candidates=3, steps=0)
    peak = (0.4 * some_states()).expand(-1, -1, actions).unsqueeze(-2)
    found = maximiser(some_states(), given=peak)
    assert (found.value >= critic.mean_value(some_states(), peak.squeeze(-2)) - 1e-12).all()


def test_leading_dimensions_are_kept():
    maximiser = ActionMaximiser(fitted(quadratic, 3), *box(3))
    flat = maximiser(some_states())
    found = maximiser(some_states().unflatten(1, (3, 4)))
    assert found.action.shape == (LEARNERS, 3, 4, 3)
    assert torch.equal(found.value.flatten(1), flat.value)


def test_ascent_never_loses_and_slides_along_a_bound():
    low, high = box(2)
    start = torch.tensor([[-0.5, 0.2], [0.9, -0.9]], dtype=torch.float64)

    def value(state: Tensor, action: Tensor) -> Tensor:
        return 5 * action[..., 0] - (action[..., 1] - 0.5).square()  # at the corner of a bound and a peak

    found = ascend(value, torch.zeros(2, 1), start, low, high, stride=0.5, steps=40)
    assert (found.value >= value(start, start)).all()
    expected = torch.tensor([1.0, 0.5], dtype=torch.float64).expand(2, 2)
    torch.testing.assert_close(found.action, expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("dims", [1, 2, 3])
def test_candidates_cover_the_box_with_its_corners(dims):
    low, high = torch.full((dims,), -2.0), torch.arange(1.0, dims + 1)
    candidates = candidate_actions(low, high, 32)
    assert ((candidates >= low) & (candidates <= high)).all()
    corners = torch.cartesian_prod(*torch.stack([low, high], -1)).reshape(-1, dims)
    assert all((candidates == corner).all(-1).any() for corner in corners)
    shares = (candidates - low) / (high - low)
    assert torch.allclose(shares.mean(0), torch.full((dims,), 0.5), atol=1 / math.sqrt(32))
    assert torch.equal(candidates, candidate_actions(low, high, 32))


def test_impossible_boxes_are_refused():
    low, high = box(1)
    with pytest.raises(ValueError, match="at least 3 candidate actions, got 2"):
        candidate_actions(low, high, 2)
    with pytest.raises(ValueError, match="finite bounds"):
        candidate_actions(low, high * torch.inf, 5)
    with pytest.raises(ValueError, match="the lower below the upper"):
        candidate_actions(high, low, 5)
