"""Robots under fixed sub-optimal policies, whose values jump: the ground truth of the graph kernels.

A system is simulated in time, many states at once. Values are returns of long roll-outs from each
state under its policy; action values take a given first action. What a learner sees are trajectories with
noisy returns.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Optional

import torch
from jaxtyping import Bool, Float
from torch import Tensor

DISCOUNT = 0.98
HORIZON = 400  # steps: the rest weighs 3e-4 of the value of a constant reward
RIDGE = 0.5  # standard deviations of the value between neighbouring states: a discontinuity
NEIGHBOUR = 1 / 30  # of the extent of the states: how far neighbours are apart in each direction
EXPLORATION = 0.5  # of the actuator's range: standard deviation of the actions whose values are learned


@dataclass(frozen=True)
class System(ABC):
    """Equations of motion, a policy, and what of a state a learner sees."""

    action_noise: float = 0.0  # standard deviation of the policy's action, in its units
    roll_outs: int = 1  # averaged for the true value of a state
    action_values: bool = False  # Q(s, a) instead of V(s)
    before: Optional["System"] = None  # the policy that made the first half of the trajectories, if another

    kind: ClassVar[str]
    centre: ClassVar[tuple[float, ...]]  # of the states that are looked at
    extent: ClassVar[tuple[float, ...]]  # half of their range
    axes: ClassVar[tuple[str, ...]] = ()  # names of the two coordinates of a state, where there are two
    most_action: ClassVar[float]
    time_step: ClassVar[float] = 0.05  # s
    substeps: ClassVar[int] = 2

    @abstractmethod
    def control(self, state: Tensor) -> Tensor:
        """The policy's action at states [..., d], without noise: [...]."""

    @abstractmethod
    def slope(self, state: Tensor, action: Tensor) -> Tensor:
        """Time derivative of states [..., d]."""

    @abstractmethod
    def reward(self, state: Tensor, action: Tensor) -> Tensor:
        """Reward of a step [...]."""

    @abstractmethod
    def inputs(self, state: Tensor) -> Tensor:
        """What a learner sees of states [..., d]: [..., D]."""

    def plane(self, inputs: Tensor) -> Tensor:
        """States [..., 2] of inputs [..., D], where `axes` names their coordinates."""
        raise NotImplementedError(f"states of {self.kind} are no points of a plane")

    def limit(self, state: Tensor) -> Tensor:
        """States held within the machine's stops."""
        return state

    @property
    def name(self) -> str:
        """How results are called."""
        noise = f", noise {self.action_noise:g}" if self.action_noise else ""
        changed = ", changed policy" if self.before else ""
        return self.kind + noise + changed + (", Q(s, a)" if self.action_values else "")

    @property
    def file_name(self) -> str:
        """The name as part of a file's name."""
        return "".join(letter if letter.isalnum() else "_" for letter in self.name)

    def sample(self, count: int) -> Float[Tensor, "count d"]:
        """Uniform states."""
        unit = 2 * torch.rand(count, len(self.extent), dtype=torch.float64) - 1
        return unit.new_tensor(self.centre) + unit * unit.new_tensor(self.extent)

    def act(self, state: Tensor, noise: float) -> Tensor:
        """The policy's action with noise of this size."""
        action = self.control(state)
        if noise:
            action = action + noise * torch.randn_like(action)
        return action.clamp(-self.most_action, self.most_action)

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Next state and reward."""
        reward, h = self.reward(state, action), self.time_step / self.substeps
        for _ in range(self.substeps):
            k1 = self.slope(state, action)
            k2 = self.slope(state + h / 2 * k1, action)
            k3 = self.slope(state + h / 2 * k2, action)
            k4 = self.slope(state + h * k3, action)
            state = self.limit(state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        return state, reward

    def values(self, states: Tensor, first_action: Tensor | None = None, roll_outs: int = 1) -> Tensor:
        """Discounted sum of rewards from each state, averaged over roll-outs; of a first action, if given."""
        state = states.expand(roll_outs, *states.shape)
        total, weight = torch.zeros(state.shape[:-1], dtype=states.dtype), 1.0
        for step in range(HORIZON):
            action = self.act(state, self.action_noise)
            if step == 0 and first_action is not None:
                action = first_action.expand_as(action)
            state, reward = self.step(state, action)
            total, weight = total + weight * reward, weight * DISCOUNT
        return total.mean(0)

    def points(self, state: Tensor, action: Tensor | None) -> Tensor:
        """Inputs of V, or of Q with the action in units of the actuator's range."""
        seen = self.inputs(state)
        return seen if action is None else torch.cat([seen, action.unsqueeze(-1) / self.most_action], -1)


@dataclass(frozen=True)
class Truth:
    """True values, in standard deviations around their mean."""

    points: Float[Tensor, "G D"]
    values: Float[Tensor, " G"]
    near: Bool[Tensor, " G"]  # next to a discontinuity
    mean: float
    scale: float


@dataclass(frozen=True)
class Trajectories:
    """What a learner sees: transitions of several trajectories, and noisy returns."""

    states: Float[Tensor, "E T D"]
    next_states: Float[Tensor, "E T D"]
    targets: Float[Tensor, "E T"]


def true_values(system: System, states: Float[Tensor, "G d"]) -> Truth:
    """Values of these states, of random first actions if action values are asked for."""
    action = system.act(states, EXPLORATION * system.most_action) if system.action_values else None
    values = system.values(states, action, system.roll_outs)
    mean, scale = float(values.mean()), float(values.std())
    near = torch.zeros(len(states), dtype=torch.bool)
    for dimension, extent in enumerate(system.extent):
        for sign in (-1, 1):
            moved = states.clone()
            moved[:, dimension] += sign * NEIGHBOUR * extent
            near |= (system.values(moved, action, system.roll_outs) - values).abs() > RIDGE * scale
    return Truth(system.points(states, action), (values - mean) / scale, near, mean, scale)


def experience(system: System, truth: Truth, seed: int, count: int, steps: int, noise: float) -> Trajectories:
    """Trajectories from uniform starts, with the return that followed each state as target.

    Args:
        system: robot and policy.
        truth: whose mean and scale the targets take.
        seed: of starts and of all noise.
        count: trajectories.
        steps: transitions of each.
        noise: standard deviation on targets, in those of the value.
    """
    torch.manual_seed(seed)
    if system.before is None:
        return _trajectories(system, truth, count, steps, noise)
    older = _trajectories(system.before, truth, count // 2, steps, noise)
    newer = _trajectories(system, truth, count - count // 2, steps, noise)
    return Trajectories(
        torch.cat([older.states, newer.states]),
        torch.cat([older.next_states, newer.next_states]),
        torch.cat([older.targets, newer.targets]),
    )


def _trajectories(system: System, truth: Truth, count: int, steps: int, noise: float) -> Trajectories:
    spread = EXPLORATION * system.most_action if system.action_values else system.action_noise
    state, path, actions = system.sample(count), [], []
    for _ in range(steps):
        path.append(state)
        actions.append(system.act(state, spread))
        state = system.step(state, actions[-1])[0]
    states, following = torch.stack(path, 1), torch.stack([*path[1:], state], 1)
    first = torch.stack(actions, 1) if system.action_values else None
    targets = (system.values(states, first) - truth.mean) / truth.scale
    after = system.control(following) if system.action_values else None
    return Trajectories(
        system.points(states, first),
        system.points(following, after),
        targets + noise * torch.randn_like(targets),
    )
