"""Pendulums under fixed sub-optimal policies, whose values jump: the ground truth of the graph kernels.

As in the thesis' Fig. .3 the policy does well only when the pendulum comes by slowly: near the top and slower
than `CATCH_SPEED` it is caught, elsewhere it swings freely ("jump") or is pushed along until it has the
energy to get there ("spiral"). Values of neighbouring states then differ by all that being caught is worth.
Values are returns of long roll-outs from each state, integrated by Runge-Kutta, all states at once.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

GRAVITY, FRICTION = 9.81, 0.05  # of a point mass of 1 kg on a rod of 1 m; θ = 0 upright
TIME_STEP, SUBSTEPS = 0.05, 2  # s
MOST_TORQUE = 5.0  # N m
CATCH_ANGLE, CATCH_SPEED = 0.8, 1.5  # rad, rad/s
PUSH, ENOUGH_ENERGY = 1.5, 1.15 * GRAVITY  # N m, J
DISCOUNT = 0.98
HORIZON = 400  # steps: the rest weighs 3e-4 of the value of a constant reward
FASTEST = 8.0  # rad/s, of starts and of the grid
SPEED_UNIT = 4.0  # rad/s: inputs are (cos θ, sin θ, ω / SPEED_UNIT)
RIDGE = 0.5  # standard deviations of the value between neighbours of the grid: a discontinuity


@dataclass(frozen=True)
class Problem:
    """A policy to evaluate."""

    policy: str  # "jump" or "spiral"
    action_noise: float = 0.0  # N m, standard deviation of the torque
    roll_outs: int = 1  # averaged for the true value of a state

    @property
    def name(self) -> str:
        """How results are called."""
        return f"{self.policy}, noise {self.action_noise:g}" if self.action_noise else self.policy

    @property
    def file_name(self) -> str:
        """The name without spaces and commas."""
        return self.name.replace(",", "").replace(" ", "_")


@dataclass(frozen=True)
class Truth:
    """The value on a grid over the state plane, in standard deviations around its mean."""

    states: Float[Tensor, "G 2"]
    values: Float[Tensor, " G"]
    near: Bool[Tensor, " G"]  # within two cells of a discontinuity
    mean: float
    scale: float


@dataclass(frozen=True)
class Trajectories:
    """What a learner sees: transitions of several trajectories, and noisy returns."""

    states: Float[Tensor, "E T D"]
    next_states: Float[Tensor, "E T D"]
    targets: Float[Tensor, "E T"]


def torque(policy: str, angle: Tensor, speed: Tensor) -> Tensor:
    """The policy's torque at angle θ and speed ω."""
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    caught = (wrapped.abs() < CATCH_ANGLE) & (speed.abs() < CATCH_SPEED)
    catch = (-25 * wrapped - 8 * speed).clamp(-MOST_TORQUE, MOST_TORQUE)
    if policy == "jump":
        return torch.where(caught, catch, 0.0)
    energy = 0.5 * speed.square() + GRAVITY * angle.cos()
    return torch.where(caught, catch, torch.where(energy < ENOUGH_ENERGY, PUSH * speed.sign(), 0.0))


def step(problem: Problem, state: Tensor) -> tuple[Tensor, Tensor]:
    """Next state and reward."""
    angle, speed = state.unbind(-1)
    u = torque(problem.policy, angle, speed)
    if problem.action_noise:
        u = (u + problem.action_noise * torch.randn_like(u)).clamp(-MOST_TORQUE, MOST_TORQUE)
    reward = (1 + angle.cos()) / 2 - 0.001 * u.square()

    def slope(x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], GRAVITY * x[..., 0].sin() - FRICTION * x[..., 1] + u), -1)

    h = TIME_STEP / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = slope(state)
        k2 = slope(state + h / 2 * k1)
        k3 = slope(state + h / 2 * k2)
        k4 = slope(state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state, reward


def returns(problem: Problem, states: Tensor, roll_outs: int = 1) -> Tensor:
    """Discounted sum of rewards from each state, averaged over roll-outs."""
    state = states.expand(roll_outs, *states.shape)
    total, weight = torch.zeros(state.shape[:-1], dtype=states.dtype), 1.0
    for _ in range(HORIZON):
        state, reward = step(problem, state)
        total, weight = total + weight * reward, weight * DISCOUNT
    return total.mean(0)


def inputs(states: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """(cos θ, sin θ, ω / SPEED_UNIT)."""
    angle, speed = states.unbind(-1)
    return torch.stack((angle.cos(), angle.sin(), speed / SPEED_UNIT), -1)


def true_values(problem: Problem, cells: int) -> Truth:
    """Values on a grid of cells × cells over a turn and all speeds up to FASTEST."""
    angles = torch.linspace(-math.pi, math.pi, cells, dtype=torch.float64)
    speeds = torch.linspace(-FASTEST, FASTEST, cells, dtype=torch.float64)
    states = torch.cartesian_prod(angles, speeds)
    values = returns(problem, states, problem.roll_outs)
    mean, scale = float(values.mean()), float(values.std())
    values = (values - mean) / scale
    return Truth(states, values, _near_a_ridge(values.reshape(cells, cells)), mean, scale)


def _near_a_ridge(values: Tensor) -> Tensor:
    jump = torch.zeros_like(values)
    for axis in (0, 1):
        difference = values.diff(dim=axis).abs()
        for start in (0, 1):
            side = jump.narrow(axis, start, difference.shape[axis])
            side.copy_(torch.maximum(side, difference))
    spread = torch.nn.functional.max_pool2d(jump[None, None], 3, stride=1, padding=1)[0, 0]
    return (spread > RIDGE).flatten()


def experience(
    problem: Problem, truth: Truth, seed: int, count: int, steps: int, noise: float
) -> Trajectories:
    """Trajectories from uniform starts, with the return that followed each state as target.

    Args:
        problem: policy and noise of the torque.
        truth: whose mean and scale the targets take.
        seed: of starts and of all noise.
        count: trajectories.
        steps: transitions of each.
        noise: standard deviation on targets, in those of the value.
    """
    torch.manual_seed(seed)
    extent = torch.tensor([math.pi, FASTEST], dtype=torch.float64)
    path = [(2 * torch.rand(count, 2, dtype=torch.float64) - 1) * extent]
    for _ in range(steps):
        path.append(step(problem, path[-1])[0])
    states = torch.stack(path, 1)
    targets = (returns(problem, states[:, :-1]) - truth.mean) / truth.scale
    seen = inputs(states)
    return Trajectories(seen[:, :-1], seen[:, 1:], targets + noise * torch.randn_like(targets))
