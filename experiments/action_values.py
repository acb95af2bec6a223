"""Claim 2 side by side: what processes know of the same policies, each taught in its own way.

    python -m experiments.action_values --task atwood

Learning curves compare processes whose policies have come to differ, and better policies have larger returns
to be wrong about. Here one process guides a policy, and the others are taught the same rollouts and nothing
else. Right after every update of the policy all of them say what actions are worth in fresh episodes of the
new one. The truth is the return that follows, counted on behind the time limit until the discount leaves 2 %.

Every five learners leave their errors in --out, where a later call finds them. Root mean squares over the
second half of the updates, and by how much each is below that of the process that is estimated anew, learner
by learner, go to --results.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

import envs
from experiments.policy_gradients import AT_ONCE, CLAIM_2, PERSISTENT
from torch_gprl.critics import GPActionValue
from torch_gprl.critics.returns import k_step_returns
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.learners.teaching import Teacher, make_critic
from torch_gprl.policies import GaussianPolicy
from torch_gprl.runs import bootstrap_interval

ANEW = "estimated anew"
SOLVED = PERSISTENT | AT_ONCE | {"budget": 300, "noise": 0.5, "solved": 4_000}
WAYS: dict[str, dict[str, Any]] = {
    ANEW: CLAIM_2[ANEW],
    "kept, λ = 0.0": CLAIM_2["kept, λ = 0.0"],
    "kept, λ = 1.0": CLAIM_2["kept, λ = 1.0"],
    "newest rollout alone, solved at once": SOLVED | {"replay": 1_000},
    "two rollouts kept, solved anew": SOLVED | {"replay": 2_000},
    "four rollouts kept, solved anew": SOLVED | {"replay": 4_000},
    "all experience kept, solved anew": SOLVED | {"replay": 12_000},
}
STEPS, TAIL = 200, 200  # of a judged episode, and behind it: γ^200 is 2 % for γ = 0.98
JUDGED = 5  # episodes of each learner after an update
JUDGING_SEED = 77
SIDE_BY_SIDE = 5  # learners of one program
Errors = dict[str, Float[np.ndarray, "updates L"]]


@dataclass(frozen=True)
class Options:
    """What to run."""

    task: str = "pendulum-swingup"  # id of the task
    driver: str = ANEW  # the process that guides the policy, one of WAYS
    first: int = 0  # index of the first learner; the numbers of WAYS were chosen on learners 0 to 3
    learners: int = 20  # independent learners
    num_envs: int = 5  # environments of each learner
    frames: int = 12_000  # environment steps per learner
    seed: int = 0  # of environments and policies
    out: Path = Path("runs/action-values")  # where the errors of every update go
    results: Path = Path("experiments/results")  # where the figures go


class Classroom:
    """The guiding process' teacher, who lets others hear the same rollouts.

    Args:
        learner: whose rollouts all are taught; its teacher gives way to this.
        ways: configurations of the others.
    """

    def __init__(self, learner: PolicyGradient, ways: dict[str, PolicyGradientConfig]) -> None:
        assert isinstance(learner.teacher, Teacher)
        assert isinstance(learner.policy, GaussianPolicy)
        self.own, policy = learner.teacher, learner.policy
        self.others = {
            name: Teacher(make_critic(policy, config, learner.learners), policy, config)
            for name, config in ways.items()
        }
        self.experience, self.figures = self.own.experience, self.own.figures
        learner.teacher = self  # pyright: ignore[reportAttributeAccessIssue]

    def teach(self, rollout: TensorDictBase, update: int) -> None:
        """Teach everybody a rollout, whose `value_target` sets the scale of values for all."""
        for teacher in (self.own, *self.others.values()):
            teacher.teach(rollout, update)


def main(options: Options) -> None:
    """Run what has not run, print, write."""
    torch.set_num_threads(1)
    guide = "anew" if options.driver == ANEW else "other"
    name = f"{options.task.replace('-', '_')}_{guide}"
    last = options.first + options.learners
    pieces = [recorded(name, first, options) for first in range(options.first, last, SIDE_BY_SIDE)]
    errors = {way: np.concatenate([piece[way] for piece in pieces], 1) for way in WAYS}
    late = {way: error[len(error) // 2 :].mean(0) for way, error in errors.items()}
    figures = {
        way: {"error": interval(error), "below estimated anew": interval(late[ANEW] - error)}
        for way, error in late.items()
    }
    for way, figure in figures.items():
        print(way.ljust(40), *(f"{a:.2f} [{b:.2f}, {c:.2f}]" for a, b, c in figure.values()), sep="  ")
    learners = [options.first, last - 1]
    made = {"driver": options.driver, "learners": learners, "frames": options.frames, **figures}
    options.results.mkdir(parents=True, exist_ok=True)
    path = options.results / f"action_values_{name}.json"
    path.write_text(json.dumps(made, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def recorded(name: str, first: int, options: Options) -> Errors:
    """Errors of a few learners, from an earlier call if there was one."""
    path = options.out / f"{name}-{options.frames}-{first}.json"
    if not path.exists():
        errors = run(first, min(SIDE_BY_SIDE, options.first + options.learners - first), options)
        options.out.mkdir(parents=True, exist_ok=True)
        lists = {way: error.tolist() for way, error in errors.items()}
        path.write_text(json.dumps(lists, ensure_ascii=False) + "\n", encoding="utf-8")
    return {way: np.array(lists) for way, lists in json.loads(path.read_text(encoding="utf-8")).items()}


def run(first: int, learners: int, options: Options) -> Errors:
    """Errors of every process right after every update of the policy."""
    common: dict[str, Any] = {"learners": learners, "first_learner": first, "threads": 1}
    env = envs.make(options.task, num_envs=options.num_envs, seed=options.seed, **common)
    plain = PolicyGradientConfig(total_frames=options.frames)
    ways = {name: dataclasses.replace(plain, **numbers) for name, numbers in WAYS.items()}
    learner = PolicyGradient(env, ways.pop(options.driver), seed=options.seed, first_learner=first)
    classroom = Classroom(learner, ways)
    critics = {options.driver: classroom.own.critic}
    critics |= {name: teacher.critic for name, teacher in classroom.others.items()}
    judging = envs.make(options.task, num_envs=JUDGED, seed=JUDGING_SEED, horizon=STEPS + TAIL + 1, **common)
    errors: dict[str, list[Tensor]] = {name: [] for name in WAYS}
    for _ in learner.train():
        episodes = played(judging, learner)
        for name, critic in critics.items():
            errors[name].append(error(critic, episodes, learner.config.discount))
    return {name: torch.stack(values).numpy() for name, values in errors.items()}


@torch.no_grad()
def played(env: envs.BatchEnv, learner: PolicyGradient) -> TensorDictBase:
    """Episodes of the policy as it explores; its stream of noise stays where it is."""
    noise = learner.policy.noise
    assert noise is not None
    state = noise.state()
    episodes = env.rollout(STEPS + TAIL, learner.policy, break_when_any_done=False)
    noise.restore(state)
    return episodes


@torch.no_grad()
def error(critic: GPActionValue, episodes: TensorDictBase, discount: float) -> Float[Tensor, " learners"]:
    """Root mean square error of the action values over the judged steps."""
    reward, done = (episodes.get(("next", key)).squeeze(-1) for key in ("reward", "done"))
    nothing = torch.zeros_like(reward, dtype=torch.float64)
    returns = k_step_returns(reward.double(), nothing, done, discount, STEPS + TAIL)[..., :STEPS]
    observation, action = (episodes.get(key)[..., :STEPS, :] for key in critic.in_keys)
    missed = critic.mean_value(observation, action) - returns
    return missed.square().flatten(1).mean(1).sqrt()


def interval(values: Float[np.ndarray, " L"]) -> tuple[float, float, float]:
    """Mean over learners with its 95 % interval."""
    low, high = bootstrap_interval(values)
    return float(values.mean()), float(low), float(high)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
