"""Kernels on visited states: Bellman's prior in closed form, covariances everywhere, growth that is seen."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from torch_gprl.graphs import Experience, TransitionGraph
from torch_gprl.kernels import (
    GaussianInputs,
    GeodesicKernel,
    Matern,
    SquaredExponential,
    SuccessorKernel,
    SuccessorWithRest,
)
from torch_gprl.kernels.graph import TableKernel

DISCOUNT = 0.9
ROTATION = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)
STEPS = 8  # of a trajectory
Make = Callable[[Experience], TableKernel]

KINDS: dict[str, Make] = {
    "geodesic": lambda experience: GeodesicKernel(experience, DISCOUNT, 0.8, 1.3, 4),
    "successor": lambda experience: SuccessorKernel(experience, DISCOUNT, 0.8, 1.3, 0),
    "successor, ahead": lambda experience: SuccessorKernel(experience, DISCOUNT, 0.8, 1.3, 2, 0.5),
}


@pytest.fixture(params=KINDS, scope="module")
def make(request: pytest.FixtureRequest) -> Make:
    return KINDS[request.param]


def trajectories(count: int = 5, steps: int = STEPS, *batch: int) -> tuple[Tensor, Tensor]:
    """States and next states of a linear system, trajectory after trajectory: [*batch, count · steps, 2]."""
    path = [torch.randn(*batch, count, 2, dtype=torch.float64)]
    for _ in range(steps):
        path.append(path[-1] @ ROTATION.mT)
    states = torch.stack(path, -2)
    return states[..., :-1, :].flatten(-3, -2), states[..., 1:, :].flatten(-3, -2)


def filled(landmarks: int = 12) -> Experience:
    experience = Experience(2, 60, landmarks)
    experience.add(*trajectories())
    return experience


def inputs(count: int) -> Tensor:
    return torch.randn(count, 2, dtype=torch.float64)


def test_gram_matrices_are_covariances(make: Make):
    experience = filled()
    kernel, x = make(experience), torch.cat([inputs(20), experience.states[:20], 20 + inputs(2)])
    gram = kernel(x, x).detach()
    torch.testing.assert_close(gram, gram.mT, rtol=0, atol=1e-11)
    torch.testing.assert_close(gram.diagonal(), kernel.diag(x).detach(), rtol=1e-11, atol=1e-15)
    torch.testing.assert_close(kernel(x, x.clone()), gram, rtol=0, atol=1e-5)
    assert torch.linalg.eigvalsh(gram)[0] > -1e-11


def test_a_learner_of_a_batch_has_the_kernel_of_its_own_experience(make: Make):
    states, next_states = trajectories(5, 8, 2)
    ended = torch.rand(2, 40) < 0.1
    batch = Experience(2, 60, 12, batch_shape=(2,))
    batch.add(states, next_states, ended)
    x, z = inputs(5), torch.randn(2, 4, 2, dtype=torch.float64)
    found = make(batch)(x, z)
    for learner in range(2):
        alone = Experience(2, 60, 12)
        alone.add(states[learner], next_states[learner], ended[learner])
        torch.testing.assert_close(make(alone)(x, z[learner]), found[learner], rtol=0, atol=1e-10)


def test_gradients_in_the_parameters_agree_with_finite_differences(make: Make):
    kernel, x, z = make(filled()), inputs(4), inputs(3)
    names = [name for name, _ in kernel.named_parameters()]

    def covariance(*parameters: Tensor) -> Tensor:
        return functional_call(kernel, dict(zip(names, parameters, strict=True)), (x, z))

    # jitter and the shift of the landmarks count as constants
    assert torch.autograd.gradcheck(covariance, tuple(kernel.parameters()), atol=1e-3, rtol=1e-2)


def test_gradients_in_the_inputs_agree_with_finite_differences(make: Make):
    kernel = make(filled()).requires_grad_(False)  # whose table is then kept
    arguments = inputs(2).requires_grad_(), inputs(2).requires_grad_()
    assert torch.autograd.gradcheck(kernel, arguments, atol=1e-4)


def test_a_kernel_sees_its_experience_grow_also_without_gradients(make: Make):
    experience = filled()
    kernel, x = make(experience), inputs(8)
    with torch.no_grad():
        before = kernel(x, x)
        experience.add(*trajectories(2))
        after = kernel(x, x)
        kernel.log_outputscale += 1
        louder = kernel(x, x)
    assert not torch.allclose(before, after)
    torch.testing.assert_close(make(experience)(x, x), after)
    torch.testing.assert_close(kernel(x, x), louder)


def test_without_experience_both_kernels_are_ordinary():
    empty, x = Experience(2, 60, 12), inputs(6)
    geodesic = GeodesicKernel(empty, DISCOUNT, 0.8, 1.3)
    torch.testing.assert_close(geodesic(x, x), Matern(2, 0.8, 1.3, smoothness=0.5)(x, x))
    successor = SuccessorKernel(empty, DISCOUNT, 0.8, unseen=0.5)
    torch.testing.assert_close(successor(x, x), Matern(2, 0.8, 0.5, smoothness=0.5)(x, x))


def test_on_merging_trajectories_the_laplacian_is_the_prior_of_bellman_with_white_rewards():
    count = 60
    parent = (
        torch.rand(count) * torch.arange(count)
    ).long()  # each state leads to an earlier one, or is a root
    root = torch.rand(count) < 0.1
    root[0] = True
    step = torch.zeros(count, count, dtype=torch.float64)
    step[~root, parent[~root]] = DISCOUNT
    M = torch.linalg.inv(torch.eye(count, dtype=torch.float64) - step)
    white = (1 - DISCOUNT**2) * (~root).double() + root
    graph = TransitionGraph(1, count, lambda point, nodes, used: torch.full_like(nodes[..., 0], torch.inf))
    graph.add(torch.arange(count, dtype=torch.float64).unsqueeze(-1))
    length = torch.full((count,), DISCOUNT, dtype=torch.float64).log().neg()
    child = (~root).nonzero().flatten()
    graph.connect(child, parent[child], length[child])
    torch.testing.assert_close((-graph.paths).exp(), M @ torch.diag(white) @ M.mT, rtol=0, atol=1e-15)


def test_along_a_trajectory_geodesic_correlation_falls_by_the_discount():
    experience = Experience(2, 60, 12)
    states = torch.arange(12, dtype=torch.float64).unsqueeze(-1) * torch.tensor([5.0, 3.0])
    experience.add(states, states + torch.tensor([5.0, 3.0]))
    kernel = GeodesicKernel(experience, DISCOUNT, 1.0, 1.0, 1)
    step = torch.arange(12).unsqueeze(-1) - torch.arange(12)
    torch.testing.assert_close(kernel(states, states), DISCOUNT ** step.abs().double(), rtol=0, atol=1e-6)


def test_between_states_that_only_distance_joins_a_short_geodesic_is_the_distance():
    line = torch.linspace(0, 2, 20, dtype=torch.float64).unsqueeze(-1) * torch.ones(1, 2)
    experience = Experience(2, 60, 20)
    experience.add(line, 100 + line.flip(0))  # transitions that lead nowhere near
    kernel = GeodesicKernel(experience, DISCOUNT, 1.5, 1.0, 3)
    expected = Matern(2, 1.5, smoothness=0.5)(line, line)
    torch.testing.assert_close(kernel(line, line), expected, rtol=0, atol=1e-6)


def dense_successors(experience: Experience, landmarks: Tensor) -> Tensor:
    """M K_r(·, Z) of every visited state, by a dense inverse; no trajectory's end is followed ahead.

    Ends borrow from six members of a committee, each of which lacks a third of the trajectories.
    """
    size = int(experience.size)
    step = torch.zeros(size, size, dtype=torch.float64)
    rows = torch.arange(size).unsqueeze(-1).expand(size, experience.interpolate)
    for kept in experience.without_folds(3, 0) + experience.without_folds(3, 1):
        after = experience.nearest(experience.next_states[:size], kept)
        nodes, weights = (
            torch.where(experience.ends[:size, None], of_end, inside[:size])
            for of_end, inside in (
                (after.nodes, experience.after_nodes),
                (after.weight, experience.after_weights),
            )
        )
        step.index_put_((rows, nodes), weights / 6, accumulate=True)
    step[experience.terminated[:size]] = 0
    rewards = SquaredExponential(2, 0.8)(experience.states[:size], landmarks)
    return torch.linalg.inv(torch.eye(size, dtype=torch.float64) - DISCOUNT * step) @ rewards


def test_at_visited_states_the_successor_kernel_is_that_of_the_dense_resolvent():
    states, next_states = trajectories()
    experience = Experience(2, 60, 12)
    ended = torch.zeros(40, dtype=torch.bool)
    ended[15] = True
    experience.add(states, next_states, ended)
    landmarks = experience.states[experience.landmarks]
    successors = dense_successors(experience, landmarks)
    gram = SquaredExponential(2, 0.8)(landmarks, landmarks)
    expected = successors @ torch.linalg.solve(gram, successors.mT)
    expected = 1.3 * expected / expected.diagonal().mean()
    kernel = SuccessorKernel(experience, DISCOUNT, 0.8, 1.3, 0)
    torch.testing.assert_close(kernel(states, states), expected, rtol=0, atol=1e-8)
    torch.testing.assert_close(kernel.diag(states).mean(), torch.tensor(1.3, dtype=torch.float64))


def test_following_inputs_ahead_finds_the_values_of_a_known_system():
    """Off the graph, too, the value of a smooth reward is its discounted sum along the true way."""
    experience = Experience(2, 900, 60)
    experience.add(*trajectories(60, 15))
    x, states = 0.7 * inputs(30), experience.states[experience.mask]
    centre = torch.tensor([[0.3, -0.2]], dtype=torch.float64)

    def value(points: Tensor) -> Tensor:
        total = torch.zeros(len(points), dtype=torch.float64)
        for step in range(150):
            total += DISCOUNT**step * SquaredExponential(2, 1.5)(points, centre).detach()[:, 0]
            points = points @ ROTATION.mT
        return total

    errors = {}
    for lookahead in (0, 8):
        kernel = SuccessorKernel(experience, DISCOUNT, 1.5, 1.0, lookahead)
        with torch.no_grad():
            gram = kernel(states, states) + 1e-6 * torch.eye(len(states), dtype=torch.float64)
            found = kernel(x, states) @ torch.linalg.solve(gram, value(states))
        errors[lookahead] = float((found - value(x)).square().mean().sqrt() / value(x).std())
    assert errors[8] < 0.05
    assert errors[8] < errors[0] / 2


def test_where_the_nearest_states_disagree_the_prior_stays_wide():
    """On a ridge two trajectories part; an input between them may have either fate."""
    upper = torch.stack([torch.linspace(0, 9, 10), torch.linspace(0.1, 4, 10)], -1).double()
    lower = upper * torch.tensor([1.0, -1.0])
    experience = Experience(2, 60, 18, interpolate=2)
    experience.add(torch.cat([upper[:-1], lower[:-1]]), torch.cat([upper[1:], lower[1:]]))
    kernel = SuccessorKernel(experience, DISCOUNT, 1.0, 1.0, 0)

    def undecided(x: Tensor) -> float:
        return float((kernel.features(x)[1].square() / kernel.diag(x)).detach())

    visited, between = upper[2:3], upper[2:3] * torch.tensor([1.0, 0.0])
    assert undecided(visited) < 1e-9
    assert undecided(between) > 0.05
    kernel.doubt = 2 * kernel.doubt.detach()
    assert undecided(visited) < 1e-9


def test_what_one_trajectory_tells_is_doubted_more_than_what_five_tell():
    """All roads lead down but the topmost, which alone leads up; an input beside it may do either."""
    steps = torch.linspace(0, 4, 13, dtype=torch.float64)

    def undecided(upward: int) -> float:
        roads = [torch.stack([steps, 0.1 - 0.01 * k + 0.3 * steps**2], -1) for k in range(upward)]
        roads += [torch.stack([steps, -0.3 - 0.05 * k - 0.3 * steps**2], -1) for k in range(6)]
        experience = Experience(2, 140, 40, interpolate=2)
        experience.add(*(torch.cat([road[part] for road in roads]) for part in (slice(-1), slice(1, None))))
        kernel, x = SuccessorKernel(experience, DISCOUNT, 1.0, 1.0, 6), torch.tensor([[0.01, 0.099]]).double()
        kernel.doubt = 1e-9
        return float((kernel.features(x)[1].square() / kernel.diag(x)).detach())

    assert undecided(1) > 0.05
    assert undecided(5) < 0.01


def test_a_mixture_averages_its_rest_and_takes_experience_at_the_mean():
    rest = SquaredExponential(2, 0.7, 0.4)
    kernel, x = SuccessorWithRest(filled(), DISCOUNT, rest=rest), inputs(3)
    spread = GaussianInputs(x, torch.full((3, 1), 0.2, dtype=torch.float64), (1,))
    with torch.no_grad():
        expected = kernel.told(x, x) + rest.expected(spread, spread)
        torch.testing.assert_close(kernel.expected(spread, spread), expected)
        torch.testing.assert_close(kernel.expected_pairs(spread, spread), expected.diagonal())


def test_options_out_of_range_are_named():
    experience = filled()
    with pytest.raises(ValueError, match="discount must lie between 0 and 1"):
        GeodesicKernel(experience, 1.0)
    with pytest.raises(ValueError, match="spatial_edges must be at least 1"):
        GeodesicKernel(experience, 0.9, spatial_edges=60)
    with pytest.raises(ValueError, match="lookahead must be at least 0"):
        SuccessorKernel(experience, 0.9, lookahead=-1)
    with pytest.raises(ValueError, match="unseen must be a variance of at least 0"):
        SuccessorKernel(experience, 0.9, unseen=-0.1)


def test_leading_dimensions_beyond_the_batch_are_more_inputs_of_the_same_learners(make: Make):
    experience = Experience(2, 60, 12, batch_shape=(2,))
    experience.add(*trajectories(5, 8, 2))
    kernel = make(experience)
    x, z = (torch.randn(3, 2, 4, 2, dtype=torch.float64) for _ in range(2))
    found = kernel(x, z)
    for row in range(3):
        torch.testing.assert_close(found[row], kernel(x[row], z[row]), rtol=0, atol=1e-12)


def test_a_mixture_takes_its_parameters_from_an_ordinary_kernel_of_values():
    experience = filled()
    ordinary = Matern(2, [0.4, 9.0], 0.6, smoothness=0.5)
    kernel, x = SuccessorWithRest(experience, DISCOUNT), inputs(6)
    pulled = experience.pulled_back(ordinary.lengthscale, DISCOUNT)
    with torch.no_grad():
        before = kernel(x, x)
        kernel.suit(ordinary.lengthscale, ordinary.outputscale)
        told = SuccessorKernel(experience, DISCOUNT, 2 * pulled, 0.6, unseen=0.75)
        torch.testing.assert_close(kernel(x, x), told(x, x) + 0.25 * ordinary(x, x))
        assert not torch.allclose(kernel(x, x), before)
    torch.testing.assert_close(experience.lengthscale, pulled.detach())


def test_only_amplitudes_of_the_mixture_are_fitted_and_with_the_gradient_of_all():
    kernel, x = SuccessorWithRest(filled(), DISCOUNT), inputs(5)
    learned = {name for name, parameter in kernel.named_parameters() if parameter.requires_grad}
    assert {name.split("_", 1)[1] for name in learned} == {"outputscale", "doubt"}
    kernel(x, x).sum().backward()
    found = {name: parameter.grad for name, parameter in kernel.named_parameters() if name in learned}
    kernel.requires_grad_(True).zero_grad()
    kernel(x, x).sum().backward()
    for name, parameter in kernel.named_parameters():
        if name in learned:
            torch.testing.assert_close(found[name], parameter.grad)
