"""What `exploration` compares: tasks, ways to explore, and one run with everything that is measured in it.

All arms of a learner share its numbers, the environments' random numbers and the first, random actions; only
how it acts after that differs.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.learners import DynamicProgramming, DynamicProgrammingConfig, QLearning, QLearningConfig
from torch_gprl.learners.q_learning import action_box_of
from torch_gprl.runs import evaluate

EVALUATION_SEED = 1_000_000  # the starts of all evaluations
CELLS = 20  # of the state plane, in each direction
Learner = QLearning | DynamicProgramming
Points = Callable[[Tensor], Float[Tensor, "... 2"]]


@dataclass(frozen=True)
class Setting:
    """A task, when it counts as learned, and the plane on which visited states are counted.

    Args:
        task: id.
        learner: q-learning or dynamic-programming.
        numbers: of the learner, where they are not its defaults.
        threshold: mean return of the greedy policy.
        frames: environment steps of each learner.
        every: environment steps between evaluations.
        starts: episodes of an evaluation.
        goal: reward of a step that counts as being in the goal region.
        place: observations to two coordinates.
        low, high: the plane's range.
        labels: the coordinates, with units.
        resolution: rewards are rounded to multiples of it, as if measured; 0 for those of the task.
    """

    task: str
    learner: str
    numbers: dict[str, Any]
    threshold: float
    frames: int
    every: int
    starts: int
    goal: float
    place: Points
    low: tuple[float, float]
    high: tuple[float, float]
    labels: tuple[str, str]
    resolution: float = 0.0

    @property
    def name(self) -> str:
        """The task, and whether its rewards are rounded."""
        return f"{self.task}-rounded" if self.resolution else self.task

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


CHEAPER = {"growth": 0.15, "sweeps": 20, "budget": 150}  # Q-learning's defaults, with less of everything
BY_VALUES = {
    "pendulum-explore": Setting(
        "pendulum-explore",
        "q-learning",
        CHEAPER | {"discount": 0.97},
        threshold=50.0,
        frames=1_500,
        every=100,
        starts=2,
        goal=0.5,
        place=_angle_and_speed,
        low=(-math.pi, -10.0),
        high=(math.pi, 10.0),
        labels=("angle from upright θ (rad)", "angular velocity ω (rad/s)"),
    ),
    "MountainCarContinuous-v0": Setting(
        "MountainCarContinuous-v0",
        "q-learning",
        CHEAPER | {"discount": 0.99},
        threshold=90.0,
        frames=3_000,
        every=500,
        starts=2,
        goal=50.0,
        place=lambda observation: observation,
        low=(-1.2, -0.07),
        high=(0.6, 0.07),
        labels=("position (m)", "velocity (m/step)"),
    ),
    "atwood": Setting(
        "atwood",
        "q-learning",
        CHEAPER | {"discount": 0.95},
        threshold=50.0,  # a controller that knows the machine and holds the length attains 100
        frames=1_500,
        every=200,
        starts=6,  # which differ more
        goal=0.8,
        place=_swing_angle_and_length,
        low=(-math.pi, 0.3),
        high=(math.pi, 3.0),
        labels=("angle of the swing θ (rad)", "length r (m)"),
    ),
}


def _by_plans(task: str, frames: int, every: int, **numbers: float) -> Setting:
    """The same task for dynamic programming, which needs fewer steps; what it plans is judged as it is."""
    return dataclasses.replace(
        BY_VALUES[task],
        learner="dynamic-programming",
        numbers={"growth": 0.1, "look_ahead": 0} | numbers,
        frames=frames,
        every=every,
    )


# rehearsals take two thirds of the time, and change little but on atwood; what counts as new is coarser than
# by default where a robot can always go faster than it ever did
BY_PLANS = {
    "pendulum-explore": _by_plans("pendulum-explore", 700, 25, rehearsal=0, novelty_lengthscale=2.0),
    "MountainCarContinuous-v0": _by_plans("MountainCarContinuous-v0", 1_200, 100, rehearsal=0),
    "atwood": _by_plans("atwood", 1_000, 100, novelty_lengthscale=2.0),
}
# before it is near upright the pendulum earns about 1e-9, a slope that plans can climb: not if it is rounded
ROUNDED = dataclasses.replace(BY_PLANS["pendulum-explore"], frames=800, resolution=1e-3)
BY_PLANS[ROUNDED.name] = ROUNDED
SETTINGS = {"q-learning": BY_VALUES, "dynamic-programming": BY_PLANS}

STDS = (0.1, 0.3, 0.6, 1.0, 2.0)  # of which the best for a task is the tuned one
GAUSSIAN = {f"gaussian {std}": {"exploration": "gaussian", "std": std} for std in STDS}
ANNEALED = {"annealed": {"exploration": "gaussian", "std": 1.0, "final_std": 0.05}}
MATCHED = "matched"  # gaussian, with the average σ of confidence
GIBBS = {
    "gibbs printed": {"exploration": "gibbs", "gibbs_form": "printed"},
    "gibbs robust": {"exploration": "gibbs"},
}
ARMS: dict[str, dict[str, dict[str, Any]]] = {
    "q-learning": GAUSSIAN
    | ANNEALED
    | {
        "confidence": {"exploration": "confidence"},
        "confidence x10": {"exploration": "confidence", "noise_scale": 10.0},
    }
    | GIBBS
    | {"thompson": {"exploration": "thompson"}, "upper": {"exploration": "upper"}},
    "dynamic-programming": GAUSSIAN
    | ANNEALED
    | {"confidence": {"exploration": "confidence"}}
    | GIBBS
    | {"optimism": {"exploration": "optimism"}},
}


class Rounded(Transform):
    """Rewards as multiples of a resolution."""

    def __init__(self, resolution: float) -> None:
        super().__init__(in_keys=["reward"], out_keys=["reward"])
        self.resolution = resolution

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return (obs / self.resolution).round() * self.resolution


class Watched:
    """A collection that keeps what the learner sees, and how far it strayed from the greedy action."""

    def __init__(self, learner: Learner) -> None:
        self.policy, self.inner = learner.policy, learner.collection
        low, high = action_box_of(learner.env)
        self.half = (high - low) / 2
        self.seen: list[TensorDictBase] = []

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """The next steps."""
        rollout = self.inner.rollout()
        asked = rollout.select("observation").clone()
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = self.policy(asked).get("action")
        strayed = (rollout.get("action") - greedy) / self.half
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


def start(setting: Setting, numbers: dict[str, Any], learners: range, frames: int) -> Learner:
    """The learner of a setting, on its task."""
    env = envs.make(
        setting.task, seed=0, learners=len(learners), num_envs=1, threads=1, first_learner=learners.start
    )
    if setting.resolution:
        env = TransformedEnv(env, Rounded(setting.resolution))
    numbers = {"total_frames": frames} | setting.numbers | numbers
    if setting.learner == "q-learning":
        return QLearning(env, QLearningConfig(**numbers), first_learner=learners.start)
    return DynamicProgramming(env, DynamicProgrammingConfig(**numbers), first_learner=learners.start)


def run(
    setting: Setting, numbers: dict[str, Any], learners: range, frames: int
) -> Iterator[tuple[Learner, Outcome]]:
    """Train one arm; yields after each evaluation."""
    options = {
        "learners": len(learners),
        "num_envs": setting.starts,
        "threads": 1,
        "first_learner": learners.start,
    }
    learner = start(setting, numbers, learners, frames)
    watched = Watched(learner)
    learner.collection = watched  # pyright: ignore[reportAttributeAccessIssue]
    stops, returns = [], []
    for _ in learner.train():
        if learner.frames % setting.every and learner.frames < frames:
            continue
        test = envs.make(setting.task, seed=EVALUATION_SEED, **options)
        stops.append(learner.frames)
        returns.append(evaluate(test, learner.policy).mean(1))
        seen = [part.flatten(1) for part in watched.seen]
        states = torch.cat([setting.share(part.get("observation").double()) for part in seen], 1)
        sigma = torch.stack([part.get("strayed").mean(1).sqrt() for part in seen], 1)
        reward = torch.cat([part.get(("next", "reward")).squeeze(-1) for part in seen], 1)
        yield learner, Outcome(list(stops), torch.stack(returns, 1), states, sigma, reward)
