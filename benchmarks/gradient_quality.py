"""How good are policy gradients from small batches? Noise, bias and both, for every estimator (Claim 1).

    python -m benchmarks.gradient_quality [--quick] [--batches 200] [--task Pendulum-v1]

At fixed policies, every estimator sees the same independent batches of 5 episodes of 200 steps; its critic
was fitted on one earlier batch, or on five ("replay"). The reference is the mean over many more batches of an
unbiased estimator on true returns.
Leaves gradient_quality.json and gradient_quality.png in --out.
"""

import dataclasses
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.gradient_arms import (
    ARMS,
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
from benchmarks.gradient_truth import branches
from torch_gprl.critics import GPActionValue
from torch_gprl.learners import PolicyGradientConfig

SIDE_BY_SIDE = 40  # batches, as learners of one program; all counts of batches are rounded up to it
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
    reference_batches: int = 400  # further ones, for the reference gradient
    task: str | None = None  # one task instead of all
    budget: int = 300  # basis vectors of the critics
    out: Path = field(default_factory=lambda: Path("runs/gradient-quality"))  # where results and policies go


def main(options: Options) -> None:
    """Run the comparison, print its table, leave JSON and a picture."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if options.quick:
        options = dataclasses.replace(
            options,
            batches=SIDE_BY_SIDE,
            reference_batches=SIDE_BY_SIDE,
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
    """Figures of all estimators at one policy; correlation of each critic's advantages with the true ones."""

    estimators: dict[str, Quality]
    advantages: dict[str, float]


def compare(fixed: Fixed, options: Options) -> Comparison:
    """Every estimator at one policy."""
    started, discount = time.monotonic(), fixed.setting.discount
    numbers = PolicyGradientConfig(budget=options.budget, discount=discount)
    pooled = fit_pooled(batches(fixed, 1, POOLED_SEED, POOLED * EPISODES), numbers, SIDE_BY_SIDE)
    reference = reference_gradient(fixed, options, pooled)
    truth = branches(fixed, BRANCHES_SEED)
    found: dict[str, list[Tensor]] = {arm.label: [] for arm in ARMS}
    advantages: dict[str, list[Tensor]] = {}
    for seed in _seeds(options.batches, 0):
        earlier = batches(fixed, SIDE_BY_SIDE, seed)
        several = batches(fixed, SIDE_BY_SIDE, seed + 2, REPLAYED * EPISODES)
        critics = fit_critics(earlier, several, pooled, numbers)
        new = batches(fixed, SIDE_BY_SIDE, seed + 1)
        seen = evaluations(new, critics, discount)
        for arm in ARMS:
            found[arm.label].append(gradients(arm, new, critics, seen))
        for name, critic in critics.gaussian.items():
            advantages.setdefault(name, []).append(truth.correlation(critic))
    print(f"{options.batches} batches in {time.monotonic() - started:.0f} s", flush=True)
    return Comparison(
        {label: quality(torch.cat(parts), reference) for label, parts in found.items()},
        {name: float(torch.cat(parts).mean()) for name, parts in advantages.items()},
    )


def reference_gradient(fixed: Fixed, options: Options, pooled: GPActionValue) -> Float[Tensor, " P"]:
    """Mean over many batches of true returns, less a critic's Q and with its all-action term: unbiased."""
    parts = []
    for seed in _seeds(options.reference_batches, 1_000_000):
        new = batches(fixed, SIDE_BY_SIDE, seed)
        with torch.no_grad():
            taken = pooled.mean_value(new.data["observation"], new.data["action"])
        parts.append(ascent(new, new.true_return - taken, pooled))
    return torch.cat(parts).mean(0)


def _seeds(total: int, first: int) -> Iterator[int]:
    """A seed for every group of batches that run side by side."""
    for group in range(-(-total // SIDE_BY_SIDE)):
        yield first + 10_000 * group


def show(title: str, results: Comparison) -> None:
    """Print the table of one policy."""
    print(f"\n{title}: batches of {EPISODES} × {STEPS} steps\n")
    print(f"| {'estimator':26s} | nsr (95 % interval)      | cosM | cosB | relMSE  |")
    print(f"|{'-' * 28}|--------------------------|------|------|---------|")
    for label, found in results.estimators.items():
        value, low, high = found.nsr.tolist()
        noise = f"{value:8.3g} ({low:.3g} to {high:.3g})"
        rest = f"{found.cos_mean[0]:.2f} | {found.cos_batch[0]:.2f} | {found.relative_mse[0]:7.3g}"
        print(f"| {label:26s} | {noise:24s} | {rest} |")
    correlations = ", ".join(f"{name} {value:.2f}" for name, value in results.advantages.items())
    print(f"\ncorrelation of estimated and true advantage, by critic: {correlations}", flush=True)


def write(results: dict[str, Comparison], out: Path) -> None:
    """Leave the figures with their intervals as JSON, and a picture."""
    out.mkdir(parents=True, exist_ok=True)
    plain = {
        title: {
            "advantage correlation": table.advantages,
            "estimators": {
                label: {
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
