"""A point in a box with two thin walls: neighbours on both sides of a wall are a whole tour apart.

The way leads from the left chamber over the first wall into the middle, and under the second one to the goal
on the right. Values fall with the way that is left, and jump at the walls.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from benchmarks.graph_systems import System

WALLS = ((-1 / 3, -1.0, 0.6), (1 / 3, -0.6, 1.0))  # m: where each stands, its lower and its upper end
PASSAGES = ((-0.28, 0.8), (0.38, -0.8))  # m: where the policy heads in the left and in the middle chamber
GOAL = (0.7, 0.6)  # m
DOCK = 0.05  # m from the goal: there the point stays
REACH = 0.15  # m: width of the reward


@dataclass(frozen=True)
class Maze(System):
    """A point (x, y) that moves at constant speed where its action, a heading, tells it."""

    kind = "thin walls"
    centre = (0.0, 0.0)
    extent = (1.0, 1.0)  # m
    axes = ("x in m", "y in m")
    most_action = math.pi  # rad
    speed: ClassVar[float] = 0.8  # m/s

    def control(self, state: Tensor) -> Tensor:
        """Heads for the next passage, or for the goal."""
        target = state.new_tensor(GOAL).expand(state.shape)
        for wall, passage in reversed(list(zip(WALLS, PASSAGES, strict=True))):
            target = torch.where(state[..., :1] < wall[0], state.new_tensor(passage), target)
        x, y = (target - state).unbind(-1)
        return torch.atan2(y, x)

    def slope(self, state: Tensor, action: Tensor) -> Tensor:
        """Constant speed."""
        return self.speed * torch.stack((action.cos(), action.sin()), -1)

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Next state and reward; a wall lets pass what moves along it."""
        reward = self.reward(state, action)
        moved = (state + self.time_step * self.slope(state, action)).clamp(-1, 1)
        x, y = moved.unbind(-1)
        for place, low, high in WALLS:
            across = (state[..., 0] - place) * (x - place) <= 0
            share = (place - state[..., 0]) / (x - state[..., 0]).where(across & (x != state[..., 0]), 1.0)
            height = state[..., 1] + share * (y - state[..., 1])
            x = torch.where(across & (low <= height) & (height <= high), state[..., 0], x)
        docked = self._from_goal(state) < DOCK
        return torch.where(docked.unsqueeze(-1), state, torch.stack((x, y), -1)), reward

    def reward(self, state: Tensor, action: Tensor) -> Tensor:
        """Near the goal on its side of the wall."""
        near = (-0.5 * (self._from_goal(state) / REACH).square()).exp()
        return torch.where(state[..., 0] > WALLS[-1][0], near, 0.0)

    def inputs(self, state: Tensor) -> Tensor:
        """(x, y)."""
        return state

    def plane(self, inputs: Tensor) -> Tensor:
        """(x, y)."""
        return inputs

    def _from_goal(self, state: Tensor) -> Tensor:
        return (state - state.new_tensor(GOAL)).norm(dim=-1)
