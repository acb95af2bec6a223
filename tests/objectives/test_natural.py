"""The natural step against dense Fisher matrices, and the trust region it promises."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from torch_gprl.objectives import natural_step
from torch_gprl.objectives.natural import conjugate_gradients

LEARNERS, DIMS = 3, 4
STD = 0.7
TRUST = 0.02


def parameter(*shape: int) -> nn.Parameter:
    """A parameter with a random gradient."""
    made = nn.Parameter(torch.randn(LEARNERS, *shape, dtype=torch.float64))
    made.grad = torch.randn_like(made)
    return made


def features(count: int = 200) -> Tensor:
    """Features of very different scales, other ones for each learner."""
    scale = torch.tensor([0.1, 1.0, 3.0, 10.0], dtype=torch.float64)
    return torch.randn(LEARNERS, count, DIMS, dtype=torch.float64) * scale + 0.5


def linear_divergence(weight: nn.Parameter, states: Tensor) -> Callable[[], Tensor]:
    """Mean KL(N(s·w_old, σ²) ‖ N(s·w, σ²)) of each learner: ½ (w − w_old)ᵀ F (w − w_old)."""
    old = (states @ weight.detach().unsqueeze(-1)).squeeze(-1)

    def divergence() -> Tensor:
        new = (states @ weight.unsqueeze(-1)).squeeze(-1)
        return ((new - old).square() / (2 * STD**2)).mean(-1)

    return divergence


def fisher(states: Tensor) -> Tensor:
    """E[s sᵀ]/σ² of a Gaussian policy linear in s."""
    return states.mT @ states / (states.shape[-2] * STD**2)


def test_it_is_the_dense_natural_gradient_of_a_linear_gaussian_policy():
    weight, states = parameter(DIMS), features()
    assert weight.grad is not None
    gradient, before = weight.grad.clone(), weight.detach().clone()
    norm = natural_step([weight], linear_divergence(weight, states), TRUST, damping=0.0)
    natural = torch.linalg.solve(fisher(states), gradient)
    size = (2 * TRUST / (gradient * natural).sum(-1, keepdim=True)).sqrt()
    torch.testing.assert_close(weight.detach(), before - size * natural, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(norm, gradient.norm(dim=-1))


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0])
def test_it_moves_as_far_as_the_trust_region_allows(damping):
    weight, states = parameter(DIMS), features()
    divergence = linear_divergence(weight, states)
    natural_step([weight], divergence, TRUST, damping=damping)
    torch.testing.assert_close(
        divergence().detach(), torch.full((LEARNERS,), TRUST, dtype=torch.float64), rtol=1e-6, atol=0
    )


def test_with_a_learned_spread_it_moves_about_as_far():
    weight, log_std, states = parameter(DIMS), parameter(1), features()
    old_weight, old_log_std = weight.detach().clone(), log_std.detach().clone()

    def divergence() -> Tensor:
        shift = (states @ (weight - old_weight).unsqueeze(-1)).squeeze(-1)
        old = torch.distributions.Normal(torch.zeros_like(shift), old_log_std.exp())
        return torch.distributions.kl_divergence(
            old, torch.distributions.Normal(shift, log_std.exp().expand_as(shift))
        ).mean(-1)

    natural_step([weight, log_std], divergence, TRUST)
    moved = divergence().detach()
    # the divergence is quadratic up to a third-order term, √(2 · 0.02) = 20 % at this radius
    assert ((moved / TRUST - 1).abs() < 0.2).all()
    assert not torch.equal(log_std, old_log_std)


def test_it_goes_downhill():
    weight, states = parameter(DIMS), features()
    assert weight.grad is not None
    before = weight.detach().clone()
    natural_step([weight], linear_divergence(weight, states), TRUST)
    assert ((weight.detach() - before) * weight.grad).sum(-1).max() < 0


def test_units_of_the_features_do_not_matter():
    mixing = torch.randn(DIMS, DIMS, dtype=torch.float64) + 3 * torch.eye(DIMS, dtype=torch.float64)
    weight, states = parameter(DIMS), torch.randn(LEARNERS, 200, DIMS, dtype=torch.float64)
    assert weight.grad is not None
    # s' = s M and w' = M⁻¹w give the same actions; ∂/∂w' = Mᵀ ∂/∂w
    mixed = nn.Parameter(torch.linalg.solve(mixing, weight.detach().unsqueeze(-1)).squeeze(-1))
    mixed.grad = weight.grad @ mixing
    natural_step([weight], linear_divergence(weight, states), TRUST, damping=0.0)
    natural_step([mixed], linear_divergence(mixed, states @ mixing), TRUST, damping=0.0)
    actions, others = (s @ w.detach().unsqueeze(-1) for s, w in ((states, weight), (states @ mixing, mixed)))
    torch.testing.assert_close(actions, others, rtol=1e-6, atol=1e-8)


def test_the_step_of_a_learner_does_not_depend_on_the_others():
    weight, states = parameter(DIMS), features()
    assert weight.grad is not None
    alone = nn.Parameter(weight.detach()[1:2].clone())
    alone.grad = weight.grad[1:2].clone()
    natural_step([weight], linear_divergence(weight, states), TRUST)
    natural_step([alone], linear_divergence(alone, states[1:2]), TRUST)
    torch.testing.assert_close(alone[0], weight[1], rtol=1e-6, atol=1e-8)


def test_a_learner_without_a_gradient_stays_where_it_is():
    weight, states = parameter(DIMS), features()
    assert weight.grad is not None
    weight.grad[1] = 0
    before = weight.detach().clone()
    norm = natural_step([weight], linear_divergence(weight, states), TRUST)
    moved = (weight.detach() - before).norm(dim=-1)
    assert moved[1] == norm[1] == 0
    assert (moved[[0, 2]] > 0).all()


def test_a_parameter_without_a_gradient_counts_as_flat():
    weight, other, states = parameter(DIMS), parameter(DIMS), torch.cat([features(), features()], -1)
    moved = []
    for flat in (None, torch.zeros_like(other)):
        pair = [nn.Parameter(p.detach().clone()) for p in (weight, other)]
        pair[0].grad, pair[1].grad = weight.grad, flat
        start = torch.cat([weight, other], -1).detach()

        def divergence(pair: list[nn.Parameter] = pair, start: Tensor = start) -> Tensor:
            shift = (states @ (torch.cat(pair, -1) - start).unsqueeze(-1)).squeeze(-1)
            return (shift.square() / (2 * STD**2)).mean(-1)

        natural_step(pair, divergence, TRUST)
        moved.append(torch.cat(pair, -1).detach())
    assert torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], start)


@pytest.mark.parametrize("size", [1, 5, 12])
def test_conjugate_gradients_solve_linear_systems(size):
    factor = torch.randn(LEARNERS, size, size, dtype=torch.float64)
    matrix = factor @ factor.mT + torch.eye(size, dtype=torch.float64)
    right = torch.randn(LEARNERS, size, dtype=torch.float64)

    def product(vector: Tensor) -> Tensor:
        return (matrix @ vector.unsqueeze(-1)).squeeze(-1)

    solution = conjugate_gradients(product, right, size + 3)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, right), rtol=1e-6, atol=1e-8)


def test_conjugate_gradients_stay_put_once_they_have_converged():
    right = torch.randn(LEARNERS, 6, dtype=torch.float64)
    scale = torch.tensor([[1.0], [100.0], [0.01]], dtype=torch.float64)
    solution = conjugate_gradients(lambda vector: scale * vector, right, 50)  # one iteration would do
    torch.testing.assert_close(solution, right / scale)


def test_a_step_that_the_fisher_matrix_cannot_judge_is_shortened():
    """KL = ½ (|d|² 1e-8 + 1e4 |d|⁴): the quadratic form sees only the first part."""
    weight = parameter(DIMS)
    before = weight.detach().clone()

    def divergence() -> Tensor:
        square = (weight - before).square().sum(-1)
        return 0.5 * (1e-8 * square + 1e4 * square.square())

    natural_step([weight], divergence, TRUST)
    assert (divergence() <= 4 * TRUST).all()
    assert ((weight - before).abs().sum(-1) > 0).all()


def test_a_learner_without_any_curvature_stays_where_it_is():
    weight, states = parameter(DIMS), features()
    states[1] = 0  # the policy of this learner does not depend on its parameters where it has been
    before = weight.detach().clone()
    natural_step([weight], linear_divergence(weight, states), TRUST)
    assert torch.equal(weight[1], before[1])
    assert (weight[[0, 2]] != before[[0, 2]]).all()
