"""A policy that explores by its newest parameters and acts without exploration by a mean of its recent ones.

Polyak and Juditsky (1992), "Acceleration of stochastic approximation by averaging". Steps of a fixed length
leap back and forth across an optimum; their mean is nearer to it, and a single bad step hardly moves it.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleMethodOverride=false

import copy

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_gprl.policies.gaussian import LOG_2PI, GaussianHead, GaussianPolicy, explores
from torch_gprl.policies.streams import NoiseStream


class AveragedPolicy(GaussianPolicy):
    """A Gaussian policy whose deterministic actions are those of a mean of its parameters.

    Args:
        head: mean and standard deviation of the action, the parameters that are trained.
        noise: stream of the exploration; see `NormalPolicy`.
        steps: of the policy, over which exponential weights spread, at least 1. The first so many are weighed
            alike.

    Raises:
        ValueError: fewer than one step.
    """

    followed: Tensor

    def __init__(self, head: GaussianHead, noise: NoiseStream | None, steps: int) -> None:
        if steps < 1:
            raise ValueError(f"parameters are averaged over at least 1 step, got {steps}")
        super().__init__(head, noise)
        self.steps = steps
        self.averaged = copy.deepcopy(head).requires_grad_(False)
        self.register_buffer("followed", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def follow(self) -> None:
        """Take the present parameters into the mean, and what else the head holds as it is."""
        self.followed += 1
        rate = 1 / self.followed.clamp_max(self.steps)
        for mean, parameter in zip(self.averaged.parameters(), self.head.parameters(), strict=True):
            mean.lerp_(parameter, rate.to(mean))
        for held, buffer in zip(self.averaged.buffers(), self.head.buffers(), strict=True):
            held.copy_(buffer)

    def forward(self, tensordict: TensorDictBase, *args: object, **kwargs: object) -> TensorDictBase:
        """Write the distribution's parameters, an action and its log-probability."""
        if explores():
            return super().forward(tensordict, *args, **kwargs)
        loc, scale = self.averaged.parameters_at(tensordict.get(self.averaged.in_keys[0]))
        log_prob = -(scale.log() + 0.5 * LOG_2PI).sum(-1)
        tensordict.set("loc", loc).set("scale", scale).set(self.action_key, loc)
        return tensordict.set(f"{self.action_key}_log_prob", log_prob)
