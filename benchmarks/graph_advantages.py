"""How much experience does a critic need to know which actions are better, with a graph of it and without?

    python -m benchmarks.graph_advantages [--batches 4] [--minutes 8] [--out runs/graph-advantages]

At the fixed policies of `gradient_quality` on Pendulum-v1, critics learn batches of some episodes by temporal
differences, as the learner of policy gradients does: as a stream, or all at once from a replay buffer. Then
their advantages are compared with those of brute force. Correlations are appended to advantages.jsonl in
--out; the same command goes on where it was stopped, and then leaves graph_advantages.json and a picture.
"""

import dataclasses
import itertools
import json
import math
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import torch
import tyro
from matplotlib.figure import Figure

from benchmarks.gradient_arms import at_once, fit_gaussian
from benchmarks.gradient_data import SETTINGS, STEPS, Batches, Fixed, batches, fixed_policies
from benchmarks.gradient_truth import Branches, branches
from torch_gprl.critics import KernelName
from torch_gprl.learners import PolicyGradientConfig

ARMS: tuple[tuple[KernelName, bool], ...] = (  # kernel, and whether all is solved at once
    ("squared-exponential", False),
    ("squared-exponential", True),
    ("matern-3/2", False),
    ("successor", False),
    ("successor-actions", False),
)
BRANCHES_SEED, DATA_SEED = 3_000_000, 7
LENGTHSCALE = 0.5  # of observations, in their standard deviations times √columns
NOISE = 1e-2  # of the variance of rewards


@dataclass(frozen=True)
class Options:
    """What to compare."""

    batches: int = 4  # independent ones, each with critics of its own
    episodes: tuple[int, ...] = (5, 20, 50, 100)  # of a batch
    budgets: tuple[int, ...] = (200, 600)  # basis vectors
    policies: tuple[str, ...] = ("mid", "good")
    kernels: tuple[KernelName, ...] = ()  # names of those to compare; all unless told
    minutes: float = math.inf  # after which to stop, to go on by the same command
    out: Path = field(default_factory=lambda: Path("runs/graph-advantages"))  # where results and policies go


@dataclass(frozen=True)
class Case:
    """A critic that learned so much; once judged, the correlation of its advantages in every batch."""

    policy: str
    kernel: KernelName
    budget: int
    episodes: int
    at_once: bool = False
    correlation: tuple[float, ...] = ()


def main(options: Options) -> None:
    """Fit the critics that are missing, print and leave their correlations."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    records, until = options.out / "advantages.jsonl", time.monotonic() + 60 * options.minutes
    for fixed in fixed_policies(SETTINGS[0], options.out / "policies"):
        if fixed.name in options.policies:
            complete(fixed, records, until, options)
    found = read_cases(records)
    lines = ",\n".join(json.dumps(dataclasses.asdict(case)) for case in found)
    (options.out / "graph_advantages.json").write_text(f"[\n{lines}\n]\n")
    draw(found, options.out / "graph_advantages.png")


def complete(fixed: Fixed, records: Path, until: float, options: Options) -> None:
    """Append what is missing of a policy, the least experience first."""
    title = f"{fixed.name} policy (return {fixed.mean_return:.0f})"
    done = {dataclasses.replace(case, correlation=()) for case in read_cases(records)}
    missing = [
        case
        for episodes in options.episodes
        for budget in options.budgets
        for kernel, all_at_once in ARMS
        if kernel in (options.kernels or get_args(KernelName))
        and (case := Case(title, kernel, budget, episodes, all_at_once)) not in done
    ]
    if not missing or time.monotonic() > until:
        return
    truth = branches(fixed, BRANCHES_SEED)
    for episodes, cases in itertools.groupby(missing, key=lambda case: case.episodes):
        seen = batches(fixed, options.batches, DATA_SEED, episodes)
        for case in cases:
            if time.monotonic() > until:
                return
            found = dataclasses.replace(case, correlation=correlations(case, fixed, seen, truth))
            with records.open("a") as file:
                file.write(json.dumps(dataclasses.asdict(found)) + "\n")
            print(found, flush=True)


def correlations(case: Case, fixed: Fixed, seen: Batches, truth: Branches) -> tuple[float, ...]:
    """Correlation of a critic's advantages with the true ones, for every batch."""
    numbers = PolicyGradientConfig(
        kernel=case.kernel,
        targets="differences",
        budget=case.budget,
        discount=fixed.setting.discount,
        lengthscale=LENGTHSCALE,
        noise=NOISE,
        visited=seen.data[0].numel(),
    )
    if case.at_once:
        numbers = dataclasses.replace(at_once(seen, numbers), budget=case.budget)
    return tuple(round(value, 3) for value in truth.correlation(fit_gaussian(seen, numbers)).tolist())


def read_cases(records: Path) -> list[Case]:
    """All that was found so far."""
    lines = records.read_text().splitlines() if records.exists() else []
    rows = (json.loads(line) for line in lines)
    cases = [Case(**row | {"correlation": tuple(row["correlation"])}) for row in rows]
    return sorted(cases, key=lambda case: (case.policy, case.kernel, case.budget, case.episodes))


def draw(cases: list[Case], path: Path) -> None:
    """Mean correlation against steps of experience, at the larger budget in full lines."""
    policies = dict.fromkeys(case.policy for case in cases)
    figure = Figure(figsize=(4.6 * len(policies), 3.6), layout="constrained")
    panels = figure.subplots(1, len(policies), squeeze=False, sharey=True)[0]
    most = max(case.budget for case in cases)
    for axes, policy in zip(panels, policies, strict=True):
        for index, arm in enumerate(ARMS):
            for budget in dict.fromkeys(case.budget for case in cases):
                rows = [
                    c for c in cases if (c.policy, (c.kernel, c.at_once), c.budget) == (policy, arm, budget)
                ]
                steps = [case.episodes * STEPS for case in rows]
                means = [statistics.fmean(case.correlation) for case in rows]
                label = arm[0] + (", all at once" if arm[1] else "")
                style = {"label": label} if budget == most else {"linestyle": "--", "alpha": 0.6}
                axes.plot(steps, means, marker="o", color=f"C{index}", markersize=4, **style)
        axes.set(xscale="log", xlabel="steps of experience", title=policy)
        axes.grid(alpha=0.25, linewidth=0.5)
    panels[0].set_ylabel("correlation of advantages with the truth")
    panels[0].legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
