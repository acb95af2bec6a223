"""Kernels of action values by name, and the graphs of experience that some of them stand on.

k((s, a), (s', a')) = k_s(s, s') · k_a(a, a'), with any kernel of states k_s and a squared exponential k_a,
which keeps averages over a Gaussian policy in closed form. "successor-actions" is no such product: its graph
joins states and actions, from (s, a) to s' and what the policy does there, and so follows what an action
leads to.

The graph of a kernel belongs to it, and so to what is saved and moved with the critic. A learner calls
`store_transitions` before the critic learns them, `follow_basis` afterwards, `clear_graphs` when it scales
the inputs anew, and `suit_graphs` when it fits hyper-parameters.
"""

from collections.abc import Iterator
from copy import deepcopy
from typing import Literal

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torch_gprl.critics.action_value import GPActionValue
from torch_gprl.critics.gaussian_actions import action_moments
from torch_gprl.gp import SparseOnlineGP, fit_hyperparameters
from torch_gprl.graphs import Experience, NearestEdges, TransitionGraph
from torch_gprl.kernels import (
    Columns,
    GeodesicKernel,
    Kernel,
    Matern,
    Product,
    ShortestPathKernel,
    SquaredExponential,
    SuccessorWithRest,
)

KernelName = Literal[
    "squared-exponential",
    "matern-1/2",
    "matern-3/2",
    "matern-5/2",
    "shortest-path",
    "geodesic",
    "successor",
    "successor-actions",
]
SMOOTHNESS = {"matern-1/2": 0.5, "matern-3/2": 1.5, "matern-5/2": 2.5}
LANDMARKS = 128  # of visited states
NEIGHBOURS = 4  # of a state on a graph of basis vectors
LOOKAHEAD = 5  # steps that a state off the graph is followed; more would cost more than they tell
LOOKAHEAD_OF_ACTIONS = 20  # the same of a state with an action: what an action does takes time to show
REWARDS = 2.0  # length scale of rewards over states, in standard deviations of the states


def action_value_kernel(
    name: KernelName,
    lengthscale: Float[Tensor, " D"],
    actions: int,
    learners: int,
    discount: float,
    capacity: int,
) -> Kernel:
    """The kernel of that name over (state, action), with parameters of its own for each learner.

    Args:
        name: of the kernel of states, or "successor-actions" of both.
        lengthscale: of the columns of states, then of those of actions, in units of the critic's inputs. A
            kernel on a graph takes the mean of the former.
        actions: how many columns are actions.
        learners: independent learners.
        discount: γ; a kernel on a graph needs it below 1.
        capacity: states that a graph holds: the newest visited ones, or a basis with its overshoot.

    Raises:
        ValueError: a number that no such kernel takes.
    """
    dims = len(lengthscale)
    if name == "squared-exponential":
        return SquaredExponential(dims, lengthscale, batch_shape=(learners,))
    states = dims - actions
    if name == "successor-actions":
        return _joint_kernel(lengthscale, states, learners, discount, capacity)
    of_states = _state_kernel(name, lengthscale[:states], learners, discount, capacity)
    of_actions = SquaredExponential(actions, lengthscale[states:], batch_shape=(learners,))
    first, last = tuple(range(states)), tuple(range(states, dims))
    return Columns(of_states, first, dims) * Columns(of_actions, last, dims)


def _state_kernel(
    name: KernelName, lengthscale: Tensor, learners: int, discount: float, capacity: int
) -> Kernel:
    dims, batch, length = len(lengthscale), (learners,), float(lengthscale.mean())
    if name in SMOOTHNESS:
        return Matern(dims, lengthscale, batch_shape=batch, smoothness=SMOOTHNESS[name])
    if name == "shortest-path":
        graph = TransitionGraph(dims, capacity, NearestEdges(NEIGHBOURS), batch)
        return ShortestPathKernel(graph, length, interpolate=NEIGHBOURS)
    visited = Experience(dims, capacity, min(LANDMARKS, capacity), batch_shape=batch)
    if name == "geodesic":
        return GeodesicKernel(visited, discount, length)
    return SuccessorWithRest(visited, discount, length, LOOKAHEAD)


def _joint_kernel(
    lengthscale: Tensor, states: int, learners: int, discount: float, capacity: int
) -> SuccessorWithRest:
    """On a graph of states and actions, whose distances count actions as little as values do."""
    dims, batch = len(lengthscale), (learners,)
    visited = Experience(dims, capacity, min(LANDMARKS, capacity), batch_shape=batch)
    visited.lengthscale[..., states:] = lengthscale[states:]
    rewards = lengthscale.clone()
    rewards[:states] = REWARDS
    rest = SquaredExponential(dims, lengthscale, batch_shape=batch)
    return SuccessorWithRest(visited, discount, rewards, LOOKAHEAD_OF_ACTIONS, rest)


def graphs(critic: GPActionValue) -> Iterator[TransitionGraph | Experience]:
    """The graphs that the critic's kernel stands on; none under an ordinary kernel."""
    for module in critic.gp.kernel.modules():
        if isinstance(module, TransitionGraph | Experience):
            yield module


def graph_edges(critic: GPActionValue, learner: int) -> Iterator[Float[Tensor, "edges 2 S"]]:
    """Both ends of the edges of each graph of states of one learner: visited steps, or neighbours."""
    for graph in graphs(critic):
        if isinstance(graph, TransitionGraph):
            points, ends = graph.points[learner], graph.lengths[learner].isfinite().triu(1).nonzero()
        else:
            points, used = graph.states[learner], slice(int(graph.size))
            if points.shape[-1] == critic.gp.kernel.input_dim:  # of states and actions
                continue
            goes_on = ~(graph.ends | graph.terminated)[learner, used]
            first = goes_on.nonzero().squeeze(-1)
            ends = torch.stack([first, graph.after_nodes[learner, first, 0]], -1)
        dims = points.shape[-1]
        yield points[ends] * critic.input_scale[learner, :dims] + critic.input_loc[learner, :dims]


@torch.no_grad()
def store_transitions(
    critic: GPActionValue,
    transitions: TensorDictBase,
    policy: ProbabilisticTensorDictSequential | None = None,
) -> None:
    """Store transitions in the graph of visited states; nothing under a kernel without one.

    What the critic has learned before it sees through the new graph.

    Args:
        critic: whose kernel it is.
        transitions: [learners, ...] with observation, action, and under "next" observation and terminated.
        policy: Gaussian policy, whose mean actions lead on in a graph of states and actions, from states
            stored earlier too.

    Raises:
        ValueError: a graph of states and actions without a policy.
    """
    for graph in graphs(critic):
        if isinstance(graph, TransitionGraph):
            continue
        dims, following = graph.states.shape[-1], transitions.get("next")
        action = next_action = transitions.get(critic.in_keys[1])
        if dims == critic.gp.kernel.input_dim:
            if policy is None:
                raise ValueError("a graph of states and actions needs a policy to act in the next states")
            next_action = action_moments(policy, following)[0]
            if int(graph.size):
                _follow_policy(graph, critic, policy, action.shape[-1])
        states = critic.inputs(transitions.get(critic.in_keys[0]), action)[..., :dims]
        next_states = critic.inputs(following.get(critic.in_keys[0]), next_action)[..., :dims]
        terminated = following.get("terminated").reshape(states.shape[:-1])
        newest = slice(-graph.capacity, None)
        graph.add(states[:, newest], next_states[:, newest], terminated[:, newest])


def _follow_policy(
    graph: Experience, critic: GPActionValue, policy: ProbabilisticTensorDictSequential, actions: int
) -> None:
    """Put today's actions into the next states that are stored; the graph shows it once more are added."""
    stored = graph.next_states[..., : int(graph.size), :]
    states, key = stored.shape[-1] - actions, critic.in_keys[0]
    observation = stored * critic.input_scale.unsqueeze(-2) + critic.input_loc.unsqueeze(-2)
    like = next(policy.parameters())
    data = TensorDict({key: observation[..., :states].to(like)}, stored.shape[:-1])
    action = action_moments(policy, data)[0]
    stored[..., states:] = critic.inputs(observation[..., :states], action.to(observation))[..., states:]


def suit_graphs(
    critic: GPActionValue,
    inputs: Float[Tensor, "learners N D"],
    targets: Float[Tensor, "learners N"],
    steps: int,
) -> bool:
    """Take a successor kernel's parameters, and the noise, from an ordinary kernel fitted to values.

    The process should be empty.

    Args:
        critic: whose kernel it is.
        inputs: scaled states and actions [learners, N, D].
        targets: their standardised values [learners, N].
        steps: of the optimiser.

    Returns:
        whether there was such a kernel, and no further fit is wanted.
    """
    kernel, dims = critic.gp.kernel, inputs.shape[-1]
    for successor in kernel.modules():
        if not isinstance(successor, SuccessorWithRest):
            continue
        ordinary = of_values = deepcopy(successor.rest).requires_grad_(True)
        if isinstance(kernel, Product):
            ordinary = Columns(of_values, range(successor.input_dim), dims) * kernel.parts[1]
        process = SparseOnlineGP(ordinary, 1, critic.gp.noise_variance.detach())
        fit_hyperparameters(process, inputs, targets, steps)
        successor.suit(of_values.lengthscale, of_values.outputscale)
        with torch.no_grad():
            critic.gp.log_noise_variance.copy_(process.log_noise_variance)
        critic.gp.rebase()
        return True
    return False


@torch.no_grad()
def follow_basis(critic: GPActionValue, nodes: Tensor | None = None) -> None:
    """Let the graph of basis vectors be that of the basis as it is now; nothing under other kernels.

    Args:
        critic: whose kernel it is.
        nodes: inputs [learners, N, D] to follow instead, such as those of a fit of hyper-parameters.
    """
    basis, mask = critic.gp.basis, critic.gp.mask
    if nodes is not None:
        basis, mask = nodes, torch.ones(nodes.shape[:-1], dtype=torch.bool, device=nodes.device)
    for graph in graphs(critic):
        if isinstance(graph, TransitionGraph):
            graph.follow(basis[..., : graph.points.shape[-1]], mask)


@torch.no_grad()
def clear_graphs(critic: GPActionValue) -> None:
    """Forget all states: the scaling of the inputs has changed, or a new task begins."""
    for graph in graphs(critic):
        if isinstance(graph, TransitionGraph):
            graph.eliminate(graph.mask)
        else:
            graph.size.zero_()
