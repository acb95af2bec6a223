"""The machines whose values the graph kernels learn: pendulum, cart-pole, swinging Atwood's machine.

As in the thesis' Fig. .3 the policies do well only from some states: near the top and slow, the pole is
caught, elsewhere it swings freely or is pushed along until it has the energy to get there. Values of
neighbouring states then differ by all that being caught is worth. Atwood's policy holds the bob only when it
swings little.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from benchmarks.graph_systems import System

GRAVITY = 9.81
CATCH_SPEED = 1.5  # rad/s
PUSH, ENOUGH_ENERGY = 1.5, 1.15 * GRAVITY  # N m, J
SPEED_UNIT = 4.0  # rad/s: inputs are (cos θ, sin θ, ω / SPEED_UNIT)


def upright(angle: Tensor) -> Tensor:
    """The angle from upright, wrapped to ±π."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


@dataclass(frozen=True)
class Jump(System):
    """A pendulum that is caught or swings freely: 1 kg on a rod of 1 m, state (θ, ω), θ = 0 upright."""

    catch_angle: float = 0.8  # rad from upright, within which a slow pole is caught

    kind = "jump"
    centre = (0.0, 0.0)
    extent = (math.pi, 8.0)  # rad, rad/s
    axes = ("angle from upright in rad", "speed in rad/s")
    most_action = 5.0  # N m
    friction: ClassVar[float] = 0.05  # N m s

    def control(self, state: Tensor) -> Tensor:
        """Catches near the top."""
        angle, speed = upright(state[..., 0]), state[..., 1]
        caught = (angle.abs() < self.catch_angle) & (speed.abs() < CATCH_SPEED)
        catch = (-25 * angle - 8 * speed).clamp(-self.most_action, self.most_action)
        return torch.where(caught, catch, self.otherwise(state))

    def otherwise(self, state: Tensor) -> Tensor:
        """What the policy does where it does not catch: nothing."""
        return torch.zeros_like(state[..., 0])

    def slope(self, state: Tensor, action: Tensor) -> Tensor:
        """θ̈ = g sin θ − 0.05 ω + u."""
        angle, speed = state.unbind(-1)
        return torch.stack((speed, GRAVITY * angle.sin() - self.friction * speed + action), -1)

    def reward(self, state: Tensor, action: Tensor) -> Tensor:
        """Height, less a little effort."""
        return (1 + state[..., 0].cos()) / 2 - 0.001 * action.square()

    def inputs(self, state: Tensor) -> Tensor:
        """(cos θ, sin θ, ω)."""
        angle, speed = state.unbind(-1)
        return torch.stack((angle.cos(), angle.sin(), speed / SPEED_UNIT), -1)

    def plane(self, inputs: Tensor) -> Tensor:
        """(θ, ω)."""
        return torch.stack((torch.atan2(inputs[..., 1], inputs[..., 0]), SPEED_UNIT * inputs[..., 2]), -1)


@dataclass(frozen=True)
class Spiral(Jump):
    """The same pendulum, pushed along where it is not caught, until it has the energy to reach the top."""

    kind = "spiral"

    def otherwise(self, state: Tensor) -> Tensor:
        """Pushes along."""
        angle, speed = state.unbind(-1)
        energy = 0.5 * speed.square() + GRAVITY * angle.cos()
        return torch.where(energy < ENOUGH_ENERGY, PUSH * speed.sign(), 0.0)


@dataclass(frozen=True)
class CartPole(System):
    """A pole on a cart that is caught or swings freely; state (θ, v, ω), since the place earns nothing."""

    kind = "cart-pole"
    centre = (0.0, 0.0, 0.0)
    extent = (math.pi, 1.0, 6.0)  # rad, m/s, rad/s
    most_action = 10.0  # N
    cart: ClassVar[float] = 1.0  # kg
    pole: ClassVar[float] = 0.1  # kg
    half_length: ClassVar[float] = 0.5  # m

    def control(self, state: Tensor) -> Tensor:
        """Balances near the top, with linear feedback."""
        angle, velocity, speed = upright(state[..., 0]), state[..., 1], state[..., 2]
        caught = (angle.abs() < 0.6) & (speed.abs() < 2.0)
        force = (40 * angle + 10 * speed + 2 * velocity).clamp(-self.most_action, self.most_action)
        return torch.where(caught, force, 0.0)

    def slope(self, state: Tensor, action: Tensor) -> Tensor:
        """Barto's equations of a uniform pole."""
        angle, _, speed = state.unbind(-1)
        sin, cos, half, pole = angle.sin(), angle.cos(), self.half_length, self.pole
        total = 4 * self.cart + pole + 3 * pole * sin.square()
        swing = pole * half * sin * speed.square()
        acceleration = (4 * action - 3 * pole * GRAVITY * sin * cos + 4 * swing) / total
        turning = 3 * ((self.cart + pole) * GRAVITY * sin - action * cos - swing * cos) / (half * total)
        return torch.stack((speed, acceleration, turning), -1)

    def reward(self, state: Tensor, action: Tensor) -> Tensor:
        """Height of the pole."""
        return (1 + state[..., 0].cos()) / 2 - 0.001 * (action / self.most_action).square()

    def inputs(self, state: Tensor) -> Tensor:
        """(cos θ, sin θ, v, ω)."""
        angle, velocity, speed = state.unbind(-1)
        return torch.stack((angle.cos(), angle.sin(), velocity / 2, speed / SPEED_UNIT), -1)


@dataclass(frozen=True)
class Atwood(System):
    """Swinging Atwood's machine, state (θ, r, θ̇, ṙ): the bob is held at r = 1 only where it swings little."""

    kind = "atwood"
    centre = (0.0, 1.0, 0.0, 0.0)
    extent = (1.2, 0.4, 1.5, 0.5)  # rad, m, rad/s, m/s
    most_action = 30.0  # N
    bob: ClassVar[float] = 1.0  # kg
    weight: ClassVar[float] = 2.0  # kg
    shortest: ClassVar[float] = 0.3  # m
    longest: ClassVar[float] = 3.0  # m
    little: ClassVar[float] = 3.0  # J of swinging

    def control(self, state: Tensor) -> Tensor:
        """Holds the length, or lets go."""
        angle, length, turning, speed = state.unbind(-1)
        energy = 0.5 * (length * turning).square() + GRAVITY * length * (1 - angle.cos())
        hold = (self.bob - self.weight) * GRAVITY + 30 * (length - 1) + 15 * speed
        return torch.where(energy < self.little, hold, 0.0).clamp(-self.most_action, self.most_action)

    def slope(self, state: Tensor, action: Tensor) -> Tensor:
        """(M + m) r̈ = m r θ̇² + m g cos θ − M g − u and r θ̈ = −g sin θ − 2 ṙ θ̇."""
        angle, length, turning, speed = state.unbind(-1)
        pull = self.bob * (length * turning.square() + GRAVITY * angle.cos()) - self.weight * GRAVITY - action
        swing = (-GRAVITY * angle.sin() - 2 * speed * turning) / length
        return torch.stack((turning, speed, swing, pull / (self.bob + self.weight)), -1)

    def limit(self, state: Tensor) -> Tensor:
        """The bob stops at the pulley and at the end of its rope."""
        angle, length, turning, speed = state.unbind(-1)
        stopped = (length < self.shortest) | (length > self.longest)
        held = length.clamp(self.shortest, self.longest)
        return torch.stack((angle, held, turning.clamp(-20, 20), torch.where(stopped, 0.0, speed)), -1)

    def reward(self, state: Tensor, action: Tensor) -> Tensor:
        """Near the length of 1."""
        return (-0.5 * (state[..., 1] - 1).square() / 0.2**2).exp()

    def inputs(self, state: Tensor) -> Tensor:
        """(cos θ, sin θ, r, θ̇, ṙ)."""
        angle, length, turning, speed = state.unbind(-1)
        return torch.stack((angle.cos(), angle.sin(), length, turning / SPEED_UNIT, speed / 2), -1)
