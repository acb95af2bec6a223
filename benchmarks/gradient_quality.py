"""How good are policy gradients from small batches? Noise, bias and both, for every estimator (Claim 1).

    python -m benchmarks.gradient_quality [--quick] [--batches 200] [--several 20] [--task Pendulum-v1]

At fixed policies, every estimator sees the same independent batches of 5 episodes of 200 steps; its critic
was fitted on one earlier batch, or on several ("replay", "remembered"). The reference is the mean over many
more batches of an unbiased estimator on true returns. A command that was stopped goes on where it stood.
Leaves gradient_quality.json and gradient_quality.png in --out.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.gradient_arms import (
    ARMS,
    GAUSSIAN,
    POOLED,
    REPLAYED,
    Quality,
    ascent,
    evaluations,
    fit_critics,
    fit_pooled,
    gradients,
    quality,
)
from benchmarks.gradient_data import EPISODES, SETTINGS, STEPS, Fixed, batches, fixed_policies
from benchmarks.gradient_truth import Branches, branches
from torch_gprl.critics import GPActionValue
from torch_gprl.learners import PolicyGradientConfig

SIDE_BY_SIDE = 20  # batches, as learners of one program; all counts of batches are rounded up to it
QUICK = 40  # batches
POOLED_SEED, BRANCHES_SEED = 2_000_000, 3_000_000
FIGURES = {
    "nsr": "noise: tr Cov / ‖mean‖²",
    "cos_mean": "cosine of the mean",
    "cos_batch": "cosine of a batch",
}


@dataclass(frozen=True)
class Options:
    """What to compare."""

    quick: bool = False  # 40 batches on the first task alone: shows that it works, not how good it is
    batches: int = 200  # independent batches of every policy
    several: int = 20  # of these, that critics of several earlier batches see too: those take minutes
    reference_batches: int = 800  # further ones, for the reference gradient
    task: str | None = None  # one task instead of all
    budget: int = 300  # basis vectors of the critics that learn one batch
    out: Path = field(default_factory=lambda: Path("runs/gradient-quality"))  # where results and policies go


def main(options: Options) -> None:
    """Run the comparison, print its table, leave JSON and a picture."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if options.quick:
        options = dataclasses.replace(
            options,
            batches=QUICK,
            reference_batches=QUICK,
            task=options.task or SETTINGS[0].task,
        )
    settings = [setting for setting in SETTINGS if options.task in (None, setting.task)]
    if not settings:
        known = ", ".join(setting.task for setting in SETTINGS)
        raise SystemExit(f"no comparison on task '{options.task}'; choose one of {known}")
    results: dict[str, Comparison] = {}
    for setting in settings:
        for fixed in fixed_policies(setting, options.out / "policies"):
            title = f"{setting.task}, {fixed.name} policy (return {fixed.mean_return:.0f})"
            results[title] = compare(fixed, options)
            show(title, results[title])
    write(results, options.out)


class Comparison(NamedTuple):
    """Figures of all estimators at one policy, each from so many batches; what is known of the critics.

    Args:
        estimators: figures, by the arm's label.
        advantages: correlation with the true ones, by the critic.
        batches: how many there were, by the arm's label.
    """

    estimators: dict[str, Quality]
    advantages: dict[str, float]
    batches: dict[str, int]


def compare(fixed: Fixed, options: Options) -> Comparison:
    """Every estimator at one policy."""
    started = time.monotonic()
    records = Records(options.out / "records" / f"{fixed.setting.task}-{fixed.name}-{options.budget}")
    sides = Sides(fixed, options.budget)
    reference = [
        records.recall(f"reference-{seed}", partial(sides.reference, seed))["gradient"]
        for seed in _seeds(options.reference_batches, 1_000_000)
    ]
    several = set(_seeds(min(options.several, options.batches), 0))
    groups = [
        records.recall(f"batches-{seed}", partial(sides.estimates, seed))
        if seed in several
        else records.recall(f"one-earlier-{seed}", partial(sides.estimates, seed, several=False))
        for seed in _seeds(options.batches, 0)
    ]
    print(f"{options.batches} batches in {time.monotonic() - started:.0f} s", flush=True)
    aim = torch.cat(reference).mean(0)
    found = {
        name: torch.cat([group[name] for group in groups if name in group])
        for name in (*(arm.label for arm in ARMS), *GAUSSIAN)
    }
    return Comparison(
        {arm.label: quality(found[arm.label], aim) for arm in ARMS},
        {name: float(found[name].mean()) for name in GAUSSIAN},
        {arm.label: len(found[arm.label]) for arm in ARMS},
    )


class Records:
    """Results of groups of batches in files, so that a command that was stopped goes on.

    Args:
        folder: where they go.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def recall(self, name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
        """What was kept under that name, or is made and kept now."""
        path = self.folder / f"{name}.pt"
        if not path.exists():
            partial_path = path.with_suffix(".partial")
            torch.save(make(), partial_path)
            partial_path.rename(path)
        return torch.load(path, weights_only=True)


class Sides:
    """Groups of batches that run side by side at one policy, with what all of them share.

    Args:
        fixed: the policy.
        budget: basis vectors of the critics that learn one batch.
    """

    def __init__(self, fixed: Fixed, budget: int) -> None:
        self.fixed, self.discount = fixed, fixed.setting.discount
        self.numbers = PolicyGradientConfig(budget=budget, discount=self.discount)

    @cached_property
    def pooled(self) -> GPActionValue:
        """The critic of very many batches."""
        return fit_pooled(batches(self.fixed, 1, POOLED_SEED, POOLED * EPISODES), self.numbers, SIDE_BY_SIDE)

    @cached_property
    def truth(self) -> Branches:
        """True advantages."""
        return branches(self.fixed, BRANCHES_SEED)

    def estimates(self, seed: int, several: bool = True) -> dict[str, Tensor]:
        """Every arm's gradient for each batch; each critic's correlation with the true advantages.

        Args:
            seed: of the batches.
            several: whether critics learn several earlier batches too; else their arms are left out.
        """
        earlier, before = batches(self.fixed, SIDE_BY_SIDE, seed), None
        if several:
            before = batches(self.fixed, SIDE_BY_SIDE, seed + 2, max(REPLAYED.values()) * EPISODES)
        critics = fit_critics(earlier, before, self.pooled, self.numbers)
        new = batches(self.fixed, SIDE_BY_SIDE, seed + 1)
        seen = evaluations(new, critics, self.discount)
        made = {arm.label: gradients(arm, new, before, critics, seen) for arm in ARMS if arm.critic in seen}
        return made | {name: self.truth.correlation(critic) for name, critic in critics.gaussian.items()}

    def reference(self, seed: int) -> dict[str, Tensor]:
        """True returns, less a critic's Q and with its all-action term: unbiased, and with little noise."""
        new = batches(self.fixed, SIDE_BY_SIDE, seed)
        with torch.no_grad():
            taken = self.pooled.mean_value(new.data["observation"], new.data["action"])
        return {"gradient": ascent(new.data, new.policy, new.true_return - taken, self.pooled)}


def _seeds(total: int, first: int) -> Iterator[int]:
    """A seed for every group of batches that run side by side."""
    for group in range(-(-total // SIDE_BY_SIDE)):
        yield first + 10_000 * group


def show(title: str, results: Comparison) -> None:
    """Print the table of one policy."""
    print(f"\n{title}: batches of {EPISODES} × {STEPS} steps\n")
    print(f"| {'estimator':29s} | nsr (95 % interval)      | cosM | cosB | relMSE  | batches |")
    print(f"|{'-' * 31}|--------------------------|------|------|---------|---------|")
    for label, found in results.estimators.items():
        value, low, high = found.nsr.tolist()
        noise = f"{value:8.3g} ({low:.3g} to {high:.3g})"
        rest = f"{found.cos_mean[0]:.2f} | {found.cos_batch[0]:.2f} | {found.relative_mse[0]:7.3g}"
        print(f"| {label:29s} | {noise:24s} | {rest} | {results.batches[label]:7d} |")
    correlations = ", ".join(f"{name} {value:.2f}" for name, value in results.advantages.items())
    print(f"\ncorrelation of estimated and true advantage, by critic: {correlations}", flush=True)


def write(results: dict[str, Comparison], out: Path) -> None:
    """Leave the figures with their intervals as JSON, and a picture."""
    out.mkdir(parents=True, exist_ok=True)
    plain = {
        title: {
            "advantage correlation": table.advantages,
            "estimators": {
                label: {"batches": table.batches[label]}
                | {
                    name: dict(zip(("value", "low", "high"), t.tolist(), strict=True))
                    for name, t in q._asdict().items()
                }
                for label, q in table.estimators.items()
            },
        }
        for title, table in results.items()
    }
    (out / "gradient_quality.json").write_text(json.dumps(plain, indent=2, ensure_ascii=False) + "\n")
    draw(results).savefig(out / "gradient_quality.png", dpi=150)
    print(f"\nfigures and picture are in {out}")


def draw(results: dict[str, Comparison]) -> Figure:
    """One row of panels for each policy: noise, bias, and what a single batch is worth."""
    figure = Figure(figsize=(11, 4.2 * len(results)), layout="constrained")
    panels = figure.subplots(len(results), len(FIGURES), squeeze=False, sharey=True)
    for row, (title, comparison) in zip(panels, results.items(), strict=True):
        table = comparison.estimators
        for axes, (name, meaning) in zip(row, FIGURES.items(), strict=True):
            figures = torch.stack([getattr(found, name) for found in table.values()])
            value, low, high = (column.numpy() for column in figures.unbind(1))
            places = range(len(table), 0, -1)
            axes.hlines(places, low, high, color="0.6", linewidth=2)
            axes.plot(value, places, "o", color="#1f4e8c", markersize=4)
            axes.set(xlabel=meaning, xscale="log" if name == "nsr" else "linear")
            axes.set_yticks(places, list(table))
            axes.grid(alpha=0.25, linewidth=0.5)
            axes.spines[["top", "right"]].set_visible(False)
        row[1].set_title(title, fontsize="medium")
    return figure


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
