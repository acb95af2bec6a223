"""Do policies learn faster from a critic on a graph of experience? Learning curves on Pendulum-v1.

    python -m benchmarks.graph_learning [--kernels squared-exponential successor-actions]
                                        [--groups 2] [--out runs/graph-learning]

Policy gradients with critics of one kernel or another, all else equal, a group of learners at a time. Returns
are appended to curves.jsonl in --out, and the same command goes on with the groups that are missing; then it
leaves graph_learning.json and a picture.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure

import envs
from torch_gprl.critics import KernelName
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.runs import evaluate

TASK = "Pendulum-v1"
LEARNERS, ENVS, EPISODES = 5, 4, 20  # of a group, for each learner, of the last judgement
ENV_SEED, JUDGE_SEED = 11, 77


@dataclass(frozen=True)
class Options:
    """What to compare."""

    kernels: tuple[KernelName, ...] = ("squared-exponential", "successor", "successor-actions")
    groups: int = 2  # of five learners each
    frames: int = 24_000  # environment steps of each learner
    out: Path = field(default_factory=lambda: Path("runs/graph-learning"))  # where results go


@dataclass(frozen=True)
class Curves:
    """Returns of a group of learners: while they learned, and of their last policies without noise."""

    kernel: str
    group: int
    frames: list[int]
    returns: list[list[float]]  # of each rollout, [updates, learners]
    judged: list[float]


def main(options: Options) -> None:
    """Run what is missing, and sum up."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    records = options.out / "curves.jsonl"
    done = {(curves.kernel, curves.group) for curves in read(records)}
    for group in range(options.groups):
        for kernel in options.kernels:
            if (kernel, group) not in done:
                curves = learn(kernel, group, options.frames)
                with records.open("a") as file:
                    file.write(json.dumps(asdict(curves)) + "\n")
                print(kernel, group, curves.returns[-1], curves.judged, flush=True)
    found = read(records)
    lines = ",\n".join(json.dumps(asdict(curves)) for curves in found)
    (options.out / "graph_learning.json").write_text(f"[\n{lines}\n]\n")
    draw(found, options.out / "graph_learning.png")


def learn(kernel: KernelName, group: int, frames: int) -> Curves:
    """Train a group of learners."""
    numbers = PolicyGradientConfig(
        total_frames=frames,
        controller="rbf",
        std=0.6,
        exploration="fixed",
        discount=0.97,
        targets="differences",
        kernel=kernel,
        budget=200,
        lengthscale=0.5,
        noise=0.01,
    )
    env = envs.make(TASK, learners=LEARNERS, num_envs=ENVS, seed=ENV_SEED + group, threads=1)
    learner = PolicyGradient(env, numbers, seed=group)
    steps, returns = [], []
    for figures in learner.train():
        steps.append(learner.frames)
        returns.append([round(value, 1) for value in figures["return"].tolist()])
    judge = envs.make(TASK, learners=LEARNERS, num_envs=EPISODES, seed=JUDGE_SEED, threads=1)
    judged = [round(value, 1) for value in evaluate(judge, learner.policy).mean(1).tolist()]
    return Curves(kernel, group, steps, returns, judged)


def read(records: Path) -> list[Curves]:
    """All curves so far."""
    lines = records.read_text().splitlines() if records.exists() else []
    return [Curves(**json.loads(line)) for line in lines]


def draw(found: list[Curves], path: Path) -> None:
    """Means over learners, with the standard error as a band."""
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    for index, kernel in enumerate(dict.fromkeys(curves.kernel for curves in found)):
        groups = [curves for curves in found if curves.kernel == kernel]
        returns = np.concatenate([np.array(curves.returns) for curves in groups], axis=1)
        mean, error = returns.mean(1), returns.std(1, ddof=1) / np.sqrt(returns.shape[1])
        axes.plot(groups[0].frames, mean, color=f"C{index}", label=f"{kernel}, {returns.shape[1]} learners")
        axes.fill_between(groups[0].frames, mean - error, mean + error, color=f"C{index}", alpha=0.2, lw=0)
    axes.set(xlabel="environment steps", ylabel="return of rollouts, with exploration", title=TASK)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
