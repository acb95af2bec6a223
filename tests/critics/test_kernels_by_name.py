"""Kernels of action values by name: what they are, and the graphs that grow under them."""

from copy import deepcopy
from typing import get_args

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torch_gprl.critics import (
    GPActionValue,
    KernelName,
    action_value_kernel,
    clear_graphs,
    follow_basis,
    graph_edges,
    graphs,
    store_transitions,
    suit_graphs,
)
from torch_gprl.gp import SparseOnlineGP, fit_hyperparameters
from torch_gprl.graphs import Experience, TransitionGraph
from torch_gprl.kernels import GaussianInputs, Matern, SquaredExponential, SuccessorWithRest
from torch_gprl.policies import GaussianPolicy, LinearController, gaussian_policy

LEARNERS, STATES, ACTIONS, DISCOUNT = 2, 2, 1, 0.9
LENGTHSCALE = torch.tensor([0.5, 0.8, 3.0], dtype=torch.float64)
ON_GRAPHS = ("shortest-path", "geodesic", "successor", "successor-actions")
CLOSED = [name for name in get_args(KernelName) if name != "successor-actions"]


def made(name: KernelName, capacity: int = 80) -> GPActionValue:
    kernel = action_value_kernel(name, LENGTHSCALE, ACTIONS, LEARNERS, DISCOUNT, capacity)
    return GPActionValue(SparseOnlineGP(kernel, 40, 0.05, 0.0))


def acting() -> GaussianPolicy:
    """A policy of one action, −s₁ + s₂ / 2 within ±1."""
    controller = LinearController(STATES, ACTIONS, (LEARNERS,))
    with torch.no_grad():
        controller.weight.copy_(torch.tensor([[-1.0], [0.5]]))
    spec = Bounded(-1.0, 1.0, (LEARNERS, 1, ACTIONS), dtype=torch.float64)
    return gaussian_policy(controller.double(), spec, 0.3, 0, learners=range(LEARNERS))


def transitions(steps: int = 20) -> TensorDict:
    """Two trajectories of each learner that turn in the plane."""
    turn = torch.tensor([[0.9, -0.3], [0.3, 0.9]], dtype=torch.float64)
    path = [torch.randn(LEARNERS, 2, STATES, dtype=torch.float64)]
    for _ in range(steps):
        path.append(path[-1] @ turn.mT)
    states = torch.stack(path, 2)
    shape = (LEARNERS, 2, steps)
    following = {"observation": states[:, :, 1:], "terminated": torch.zeros(*shape, 1, dtype=torch.bool)}
    data = {
        "observation": states[:, :, :-1],
        "action": torch.randn(*shape, ACTIONS, dtype=torch.float64),
        "next": TensorDict(following, shape),
        "value_target": states[:, :, :-1, :1],
    }
    return TensorDict(data, shape)


@pytest.mark.parametrize("name", CLOSED)
def test_covariances_are_positive_and_averages_over_actions_are_closed(name):
    critic, data = made(name), transitions()
    store_transitions(critic, data)
    critic.update(data)
    follow_basis(critic)
    x = critic.inputs(data["observation"], data["action"])
    with torch.no_grad():
        kernel = critic.gp.kernel
        assert kernel.batch_shape == (LEARNERS,)
        assert torch.linalg.eigvalsh(kernel(x, x)).min() > -1e-9
        spread = GaussianInputs(x[:, :3], torch.full((LEARNERS, 3, 1), 0.49, dtype=torch.float64), (2,))
        drawn = x[:, :3].repeat(1, 2_000, 1)
        drawn[..., 2] += 0.7 * torch.randn(LEARNERS, 6_000, dtype=torch.float64)
        sampled = kernel(drawn, x[:, 5:6]).reshape(LEARNERS, 2_000, 3, 1).mean(1)
        torch.testing.assert_close(kernel.expected(spread, x[:, 5:6]), sampled, rtol=0.02, atol=2e-3)


def test_without_a_graph_they_are_the_stationary_kernels_of_that_name():
    x = torch.randn(LEARNERS, 5, 3, dtype=torch.float64)
    squared = made("squared-exponential").gp.kernel(x, x)
    torch.testing.assert_close(squared, SquaredExponential(3, LENGTHSCALE)(x, x))
    matern = made("matern-1/2").gp.kernel(x, x)
    action = SquaredExponential(1, LENGTHSCALE[2])(x[..., 2:], x[..., 2:])
    expected = Matern(2, LENGTHSCALE[:2], smoothness=0.5)(x[..., :2], x[..., :2]) * action
    torch.testing.assert_close(matern, expected)


@pytest.mark.parametrize("name", ON_GRAPHS)
def test_graphs_grow_with_experience_and_keep_the_newest(name):
    critic = made(name, capacity=60)
    for round_ in range(2):
        data = transitions()
        store_transitions(critic, data, acting())
        critic.update(data)
        follow_basis(critic)
        (graph,) = graphs(critic)
        if isinstance(graph, TransitionGraph):
            assert torch.equal(graph.size, critic.gp.size)
        else:
            assert int(graph.size) == min(40 * (round_ + 1), 60)
            newest = data["observation"].flatten(1, 2)[:, -40:]
            stored = graph.states[:, int(graph.size) - 40 : int(graph.size), :STATES]
            torch.testing.assert_close(stored, newest)
    clear_graphs(critic)
    (graph,) = graphs(critic)
    assert not graph.mask.any()
    assert all(torch.isfinite(part).all() for part in critic.value(data["observation"], data["action"]))


def test_more_transitions_than_a_graph_holds_leave_the_newest():
    critic, data = made("successor", capacity=30), transitions()
    store_transitions(critic, data)
    (graph,) = graphs(critic)
    assert isinstance(graph, Experience)
    torch.testing.assert_close(graph.states, data["observation"].flatten(1, 2)[:, -30:])


def test_a_saved_critic_brings_its_graph_along():
    critic, other, data = made("geodesic"), made("geodesic"), transitions()
    store_transitions(critic, data)
    critic.update(data)
    other.load_state_dict(critic.state_dict())
    for found, expected in zip(
        other.value(data["observation"], data["action"]),
        critic.value(data["observation"], data["action"]),
        strict=True,
    ):
        torch.testing.assert_close(found, expected)


def test_edges_are_those_of_neighbours_or_of_visited_steps():
    data = transitions()
    critic = made("geodesic")
    critic.standardise(data["observation"], data["action"], data["value_target"])
    store_transitions(critic, data)
    (edges,) = graph_edges(critic, 1)
    steps = torch.stack([data["observation"][1], data["next", "observation"][1]], -2)
    expected = steps[:, :-1].flatten(0, 1)  # what follows the last step was not visited
    torch.testing.assert_close(edges, expected)
    critic = made("shortest-path")
    critic.update(data)
    follow_basis(critic)
    (edges,) = graph_edges(critic, 0)
    (graph,) = graphs(critic)
    assert isinstance(graph, TransitionGraph)
    assert len(edges) == graph.degrees()[0].sum() / 2
    assert list(graph_edges(made("matern-1/2"), 0)) == []


def test_a_graph_is_measured_by_what_values_depend_on():
    critic, data = made("successor"), transitions()
    store_transitions(critic, data)
    x = critic.inputs(data["observation"], data["action"])
    (graph,) = graphs(critic)
    assert isinstance(graph, Experience)
    nodes = graph.nearest(x[..., :STATES]).nodes
    values = (3 * x[..., 0]).sin() + 0.01 * torch.randn(x.shape[:-1], dtype=torch.float64)
    assert suit_graphs(critic, x[:, :40], values[:, :40], 40)
    assert (critic.gp.noise_variance < 0.01).all()  # as that of these values, not 0.05
    assert (graph.lengthscale[:, 0] < 0.8 * graph.lengthscale[:, 1]).all()
    assert not torch.equal(graph.nearest(x[..., :STATES]).nodes, nodes)
    ordinary = made("matern-3/2")
    assert not suit_graphs(ordinary, x, values, 1)  # nothing to do
    torch.testing.assert_close(ordinary.gp.kernel(x, x), made("matern-3/2").gp.kernel(x, x))


def test_on_a_graph_of_states_and_actions_todays_policy_leads_on():
    critic, policy = made("successor-actions"), acting()
    first, second = transitions(), transitions()
    store_transitions(critic, first, policy)
    with torch.no_grad():
        policy.head.controller.weight.mul_(-0.5)
    store_transitions(critic, second, policy)
    (graph,) = graphs(critic)
    assert isinstance(graph, Experience)
    with torch.no_grad():
        for data, rows in ((first, slice(0, 40)), (second, slice(40, 80))):
            following = data["next", "observation"].flatten(1, 2)
            action = policy.head.parameters_at(following)[0]
            torch.testing.assert_close(graph.next_states[:, rows], critic.inputs(following, action))
            taken = critic.inputs(data["observation"], data["action"])
            torch.testing.assert_close(graph.states[:, rows], taken)
    assert list(graph_edges(critic, 0)) == []
    with pytest.raises(ValueError, match="needs a policy to act"):
        store_transitions(critic, first)


def test_a_graph_of_states_and_actions_takes_its_parameters_from_a_squared_exponential():
    critic, data = made("successor-actions"), transitions()
    store_transitions(critic, data, acting())
    x = critic.inputs(data["observation"], data["action"])
    values = (3 * x[..., 0]).sin() + 0.01 * torch.randn(x.shape[:-1], dtype=torch.float64)
    kernel = critic.gp.kernel
    assert isinstance(kernel, SuccessorWithRest)
    ordinary = SparseOnlineGP(deepcopy(kernel.rest).requires_grad_(True), 1, 0.05)
    fit_hyperparameters(ordinary, x, values, 30)
    assert suit_graphs(critic, x, values, 30)
    torch.testing.assert_close(critic.gp.noise_variance, ordinary.noise_variance)
    torch.testing.assert_close(kernel.rest.lengthscale, ordinary.kernel.lengthscale)
    assert (kernel.rest.lengthscale[:, 0] < 0.5 * kernel.rest.lengthscale[:, 2]).all()
    torch.testing.assert_close(kernel.told.outputscale, 4 * kernel.rest.outputscale)
