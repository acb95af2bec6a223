"""Streams of inputs and noisy targets that Gaussian processes are compared on, all generated from a seed.

Every stream is standardised (inputs and targets have mean 0 and variance 1 over stream and test set together)
and comes with the hyper-parameters that all peers are given, so that like is compared with like.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_gprl.kernels import SquaredExponential

TEST_POINTS = 1000
TEST_TRAJECTORIES = 50  # that the test points of simulated streams are spread over
DISCOUNT = 0.97


@dataclass(frozen=True)
class Stream:
    """Data in order of arrival, held-out data, and hyper-parameters.

    Args:
        inputs: [N, D].
        targets: [N].
        test_inputs: [M, D], never learned from.
        test_targets: [M].
        lengthscale: of a squared exponential kernel, the same for all columns; its output scale is 1.
        noise_variance: of the targets.
    """

    inputs: Tensor
    targets: Tensor
    test_inputs: Tensor
    test_targets: Tensor
    lengthscale: float
    noise_variance: float

    @property
    def kernel(self) -> SquaredExponential:
        """A fresh kernel with the stream's hyper-parameters, without gradients."""
        return SquaredExponential(self.inputs.shape[-1], self.lengthscale).requires_grad_(False)


def pendulum(points: int, seed: int = 0) -> Stream:
    """Angle, angular velocity and torque along simulated swings, with the discounted return: 3 inputs.

    A torque-limited pendulum (1 kg, 1 m, Euler steps of 0.05 s) that pumps up its energy and explores with
    autoregressive noise; rewards penalise angle, speed and effort, as in Gymnasium's Pendulum-v1.
    """
    generator = torch.Generator().manual_seed(seed)
    length, horizon = 200, 100  # steps that are learned from, and steps that only pay
    trajectories = math.ceil(points / length) + TEST_TRAJECTORIES
    angle, speed, noise = 3.0 * _normal(generator, 3, trajectories)
    states, rewards = [], []
    for _ in range(length + horizon):
        noise = 0.8 * noise + 0.2 * _normal(generator, trajectories)
        missing_energy = 15 * (1 - angle.cos()) - 0.5 * speed.square()
        torque = (0.2 * speed * missing_energy + noise).clamp(-2, 2)
        states.append(torch.stack([angle, speed, torque], -1))
        rewards.append(-(angle.square() + 0.1 * speed.square() + 0.001 * torque.square()))
        speed = (speed + 0.05 * (15 * angle.sin() + 3 * torque)).clamp(-8, 8)
        angle = torch.remainder(angle + 0.05 * speed + math.pi, 2 * math.pi) - math.pi
    returns = _discounted(torch.stack(rewards, 1))[:, :length]
    inputs, targets = _in_order(torch.stack(states, 1)[:, :length], returns, points)
    return _standardised(inputs, targets, points, lengthscale=0.7, noise_variance=0.12)


def novel(points: int, seed: int = 0) -> Stream:
    """A smooth random function of 8 independent inputs, so rough that every point is news.

    It stands in for kin40k, the forward dynamics of an arm, which would have to be downloaded.
    """
    generator = torch.Generator().manual_seed(seed)
    inputs = _normal(generator, points + TEST_POINTS, 8)
    targets = _smooth_function(inputs, 2.5, generator)
    targets = targets + 0.1 * _normal(generator, len(targets))
    return _standardised(inputs, targets, points, lengthscale=2.5, noise_variance=0.01)


def cheetah(points: int, seed: int = 0) -> Stream:
    """17 states that rotate and drift with 6 autoregressive actions, and a discounted return: 23 inputs."""
    generator = torch.Generator().manual_seed(seed)
    length, horizon = 500, 100
    walks = math.ceil(points / length) + TEST_TRAJECTORIES
    turn = torch.linalg.matrix_exp(0.05 * (lambda a: a - a.mT)(_normal(generator, 17, 17)))
    push, goal = 0.1 * _normal(generator, 6, 17), _normal(generator, 17) / 17**0.5
    state, action = _normal(generator, walks, 17), _normal(generator, walks, 6)
    visited, rewards = [], []
    for _ in range(length + horizon):
        action = 0.8 * action + 0.6 * _normal(generator, walks, 6)
        visited.append(torch.cat([state, action], -1))
        rewards.append((state @ goal).tanh() - 0.05 * action.square().sum(-1))
        state = 0.97 * state @ turn + action @ push + 0.1 * _normal(generator, walks, 17)
    returns = _discounted(torch.stack(rewards, 1))[:, :length]
    inputs, targets = _in_order(torch.stack(visited, 1)[:, :length], returns, points)
    return _standardised(inputs, targets, points, lengthscale=5.0, noise_variance=0.3)


def settled(points: int, seed: int = 0) -> Stream:
    """A function of 3 inputs so smooth that a few dozen basis vectors say it all: news is rare."""
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.rand(points + TEST_POINTS, 3, dtype=torch.float64, generator=generator)
    targets = (3 * inputs).sin().prod(-1)
    targets = targets + targets.std() * 0.3 * _normal(generator, len(targets))
    return _standardised(inputs, targets, points, lengthscale=1.5, noise_variance=0.08)


def near_duplicates(points: int, seed: int = 0) -> Stream:
    """300 places in 3 dimensions, visited over and over up to 1e-6: where explicit inverses break."""
    generator = torch.Generator().manual_seed(seed)
    centres = _normal(generator, 300, 3)
    count = points + TEST_POINTS
    inputs = centres[torch.randint(300, (count,), generator=generator)] + 1e-6 * _normal(generator, count, 3)
    targets = _smooth_function(inputs, 1.0, generator) + 0.1 * _normal(generator, count)
    return _standardised(inputs, targets, points, lengthscale=1.0, noise_variance=0.01)


STREAMS: dict[str, Callable[..., Stream]] = {
    "pendulum": pendulum,
    "every point novel": novel,
    "cheetah-like": cheetah,
    "settled": settled,
    "near duplicates": near_duplicates,
}


def uniform(points: int, dims: int, seed: int = 0) -> Stream:
    """The smooth random function of `novel` in any number of dimensions, to see how cost grows with them."""
    generator = torch.Generator().manual_seed(seed)
    inputs = _normal(generator, points + TEST_POINTS, dims)
    lengthscale = 0.9 * dims**0.5  # keeps typical correlations alike
    targets = _smooth_function(inputs, lengthscale, generator) + 0.1 * _normal(generator, len(inputs))
    return _standardised(inputs, targets, points, lengthscale, noise_variance=0.02)


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


def _smooth_function(inputs: Tensor, lengthscale: float, generator: torch.Generator) -> Tensor:
    """A draw from a squared exponential prior, by 1,000 random Fourier features (Rahimi and Recht, 2007)."""
    frequencies = _normal(generator, inputs.shape[-1], 1000) / lengthscale
    phases = 2 * math.pi * torch.rand(1000, dtype=torch.float64, generator=generator)
    return (inputs @ frequencies + phases).cos() @ _normal(generator, 1000) * (2 / 1000) ** 0.5


def _discounted(rewards: Tensor) -> Tensor:
    """Returns [trajectories, T] by the sum of discounted rewards from each step on."""
    returns, following = torch.empty_like(rewards), torch.zeros_like(rewards[:, 0])
    for step in reversed(range(rewards.shape[1])):
        following = returns[:, step] = rewards[:, step] + DISCOUNT * following
    return returns


def _in_order(inputs: Tensor, returns: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """Points along one trajectory [E, T] after the other, then test points from trajectories of their own."""
    every = inputs.shape[1] * TEST_TRAJECTORIES // TEST_POINTS
    learned, held_out = slice(-TEST_TRAJECTORIES), slice(-TEST_TRAJECTORIES, None)
    parts = (
        (data[learned].flatten(0, 1)[:points], data[held_out, ::every].flatten(0, 1))
        for data in (inputs, returns)
    )
    inputs, returns = map(torch.cat, parts)
    return inputs, returns


def _standardised(
    inputs: Tensor, targets: Tensor, points: int, lengthscale: float, noise_variance: float
) -> Stream:
    """The first `points` are the stream, the next the test set."""
    inputs = (inputs - inputs.mean(0)) / inputs.std(0)
    targets = (targets - targets.mean()) / targets.std()
    return Stream(
        inputs[:points], targets[:points], inputs[points:], targets[points:], lengthscale, noise_variance
    )
