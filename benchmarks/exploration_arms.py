"""What `exploration` compares: tasks, ways to explore, and one run with everything that is measured in it.

All arms share the learner, Q-learning with fitted values, its numbers, the environments' random numbers and
the first uniform actions; only what is done between the solutions differs.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

import envs
from torch_gprl.learners import QLearning, QLearningConfig
from torch_gprl.runs import evaluate

EVALUATION_SEED = 1_000_000  # the starts of all evaluations
STARTS = 2  # episodes of an evaluation, for each learner
CELLS = 20  # of the state plane, in each direction
LEARNER = {"growth": 0.15, "sweeps": 20, "budget": 150}  # numbers of Q-learning: its defaults, cheaper
Points = Callable[[Tensor], Float[Tensor, "... 2"]]


@dataclass(frozen=True)
class Setting:
    """A task, when it counts as learned, and the plane on which visited states are counted.

    Args:
        task: id.
        threshold: mean return of the greedy policy.
        frames: environment steps of each learner.
        every: environment steps between evaluations.
        discount: γ.
        goal: reward of a step that counts as being in the goal region.
        place: observations to two coordinates.
        low, high: the plane's range.
        labels: the coordinates, with units.
    """

    task: str
    threshold: float
    frames: int
    every: int
    discount: float
    goal: float
    place: Points
    low: tuple[float, float]
    high: tuple[float, float]
    labels: tuple[str, str]

    def share(self, observation: Tensor) -> Float[Tensor, "... 2"]:
        """Where observations lie in the plane, [0, 1) in each direction."""
        low, high = observation.new_tensor(self.low), observation.new_tensor(self.high)
        return ((self.place(observation) - low) / (high - low)).clamp(0, 1 - 1e-6)


def _angle_and_speed(observation: Tensor) -> Tensor:
    cosine, sine, ω = observation.unbind(-1)
    return torch.stack([torch.atan2(sine, cosine), ω], -1)


def _swing_angle_and_length(observation: Tensor) -> Tensor:
    cosine, sine, r, _, _ = observation.unbind(-1)
    return torch.stack([torch.atan2(sine, cosine), r], -1)


SETTINGS = {
    "pendulum-explore": Setting(
        "pendulum-explore",
        threshold=50.0,
        frames=1_500,
        every=100,
        discount=0.97,
        goal=0.5,
        place=_angle_and_speed,
        low=(-math.pi, -10.0),
        high=(math.pi, 10.0),
        labels=("angle from upright θ (rad)", "angular velocity ω (rad/s)"),
    ),
    "MountainCarContinuous-v0": Setting(
        "MountainCarContinuous-v0",
        threshold=90.0,
        frames=3_000,
        every=500,
        discount=0.99,
        goal=50.0,
        place=lambda observation: observation,
        low=(-1.2, -0.07),
        high=(0.6, 0.07),
        labels=("position (m)", "velocity (m/step)"),
    ),
    "atwood": Setting(
        "atwood",
        threshold=100.0,
        frames=1_500,
        every=200,
        discount=0.95,
        goal=0.8,
        place=_swing_angle_and_length,
        low=(-math.pi, 0.3),
        high=(math.pi, 3.0),
        labels=("angle of the swing θ (rad)", "length r (m)"),
    ),
}

STDS = (0.1, 0.3, 0.6, 1.0)  # of which the best for a task is the tuned one
GAUSSIAN = {f"gaussian {std}": {"std": std} for std in STDS}
GUIDED: dict[str, dict[str, Any]] = {
    "confidence": {"exploration": "confidence"},
    "confidence x10": {"exploration": "confidence", "noise_scale": 10.0},
    "gibbs printed": {"exploration": "gibbs", "gibbs_form": "printed"},
    "gibbs robust": {"exploration": "gibbs"},
    "thompson": {"exploration": "thompson"},
    "upper": {"exploration": "upper"},
}
MATCHED = "matched"  # gaussian, with the average σ of confidence
ARMS: dict[str, dict[str, Any]] = GAUSSIAN | {"annealed": {"std": 1.0, "final_std": 0.05}} | GUIDED


class Watched:
    """A collection that keeps what the learner sees, and how far it strayed from the greedy action."""

    def __init__(self, learner: QLearning) -> None:
        self.learner, self.inner = learner, learner.collection
        self.seen: list[TensorDictBase] = []

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """The next steps."""
        rollout = self.inner.rollout()
        box, observation = self.learner.maximiser, rollout.get("observation")
        half = (box.high - box.low) / 2
        strayed = (rollout.get("action") - box(observation).action) / half
        kept = rollout.select("observation", ("next", "reward")).clone()
        self.seen.append(kept.set("strayed", strayed.square().mean(-1)))
        return rollout


@dataclass
class Outcome:
    """What one arm did, [learners, ...] each."""

    frames: list[int]  # environment steps at the evaluations
    returns: Float[Tensor, "learners K"]  # of the greedy policy
    states: Float[Tensor, "learners T 2"]  # visited, as shares of the plane
    sigma: Float[Tensor, "learners U"]  # root mean square distance to the greedy action, by update, in halves
    reward: Float[Tensor, "learners T"]

    @classmethod
    def of_all(cls, groups: Sequence["Outcome"]) -> "Outcome":
        """Groups of learners as one."""
        names = ("returns", "states", "sigma", "reward")
        return cls(groups[0].frames, *(torch.cat([getattr(one, name) for one in groups]) for name in names))

    def measures(self, setting: Setting) -> dict[str, Tensor]:
        """Figures of each learner [learners]."""
        index = (self.states * CELLS).long()
        cells = index[..., 0] * CELLS + index[..., 1]
        counts = torch.stack([torch.bincount(row, minlength=CELLS**2) for row in cells]).double()
        share = counts / counts.sum(1, keepdim=True)
        late = self.returns[:, -1]
        return {
            "steps to threshold": steps_to(self.frames, self.returns, setting),
            "steps to discovery": first_step(self.reward >= setting.goal),
            "final return": late,
            "time in goal": (self.reward >= setting.goal).double().mean(1),
            "entropy of cells": -torch.xlogy(share, share).sum(1),
            "new cells per 1,000 steps": (counts > 0).sum(1) * 1000 / self.states.shape[1],
            # without the first rollout, whose actions are uniform
            "mean sigma": self.sigma[:, 1 if self.sigma.shape[1] > 1 else 0 :].square().mean(1).sqrt(),
        }


def steps_to(frames: list[int], returns: Float[Tensor, "learners K"], setting: Setting) -> Tensor:
    """Environment steps at the first of two evaluations in a row above the threshold [learners].

    Learners that never get there, or only in the last evaluation, count as one evaluation after the end.
    """
    above = returns >= setting.threshold
    sustained = above & torch.cat([above[:, 1:], torch.zeros_like(above[:, :1])], 1)
    ends = torch.tensor([*frames, frames[-1] + setting.every], dtype=torch.float64)
    first = torch.where(sustained.any(1), sustained.int().argmax(1), len(frames))
    return ends[first]


def first_step(happened: Tensor) -> Tensor:
    """Index of the first step at which something happened [learners], their number if it never did."""
    return torch.where(happened.any(1), happened.int().argmax(1), happened.shape[1]).double()


def run(
    setting: Setting, numbers: dict[str, Any], learners: range, frames: int
) -> Iterator[tuple[QLearning, Outcome]]:
    """Train one arm; yields after each evaluation."""
    count = len(learners)
    options = {"learners": count, "num_envs": 1, "threads": 1, "first_learner": learners.start}
    config = QLearningConfig(total_frames=frames, discount=setting.discount, **LEARNER | numbers)
    env = envs.make(setting.task, seed=0, **options)
    learner = QLearning(env, config, seed=0, first_learner=learners.start)
    watched = Watched(learner)
    learner.collection = watched  # pyright: ignore[reportAttributeAccessIssue]
    stops, returns = [], []
    for _ in learner.train():
        if learner.frames % setting.every and learner.frames < frames:
            continue
        test = envs.make(setting.task, seed=EVALUATION_SEED, **options | {"num_envs": STARTS})
        stops.append(learner.frames)
        returns.append(evaluate(test, learner.policy).mean(1))
        seen = [part.flatten(1) for part in watched.seen]
        states = torch.cat([setting.share(part.get("observation").double()) for part in seen], 1)
        sigma = torch.stack([part.get("strayed").mean(1).sqrt() for part in seen], 1)
        reward = torch.cat([part.get(("next", "reward")).squeeze(-1) for part in seen], 1)
        yield learner, Outcome(list(stops), torch.stack(returns, 1), states, sigma, reward)
