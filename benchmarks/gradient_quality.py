"""How good are policy gradients from small batches? Noise, bias and both, for every estimator (Claim 1).

    python -m benchmarks.gradient_quality [--quick] [--batches 200] [--task Pendulum-v1]

At fixed policies, every estimator sees the same independent batches of 5 episodes of 200 steps; its critic
was fitted on one earlier batch. The reference is the mean over many more batches, of true returns less a
baseline.
Leaves gradient_quality.json and gradient_quality.png in --out.
"""

import dataclasses
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.gradient_arms import (
    ARMS,
    Quality,
    ascent,
    evaluations,
    fit_critics,
    fit_gaussian,
    gradients,
    quality,
)
from benchmarks.gradient_data import EPISODES, SETTINGS, STEPS, Fixed, batches, fixed_policies
from torch_gprl.critics import GPValueEstimator
from torch_gprl.learners import PolicyGradientConfig

SIDE_BY_SIDE = 40  # batches, as learners of one program
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
    reference_batches: int = 800  # further ones, for the reference gradient
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
    results: dict[str, dict[str, Quality]] = {}
    for setting in settings:
        for fixed in fixed_policies(setting, options.out / "policies"):
            title = f"{setting.task}, {fixed.name} policy (return {fixed.mean_return:.0f})"
            results[title] = compare(fixed, options)
            show(title, results[title])
    write(results, options.out)


def compare(fixed: Fixed, options: Options) -> dict[str, Quality]:
    """Every estimator at one policy."""
    started, discount = time.monotonic(), fixed.setting.discount
    numbers = PolicyGradientConfig(budget=options.budget, discount=discount)
    reference = reference_gradient(fixed, options, numbers)
    found: dict[str, list[Tensor]] = {arm.label: [] for arm in ARMS}
    for count, seed in _parts(options.batches, 0):
        critics = fit_critics(batches(fixed, count, seed), numbers)
        new = batches(fixed, count, seed + 1)
        seen = evaluations(new, critics, discount)
        for arm in ARMS:
            found[arm.label].append(gradients(arm, new, critics, seen))
    print(f"{options.batches} batches in {time.monotonic() - started:.0f} s", flush=True)
    return {label: quality(torch.cat(parts), reference) for label, parts in found.items()}


def reference_gradient(fixed: Fixed, options: Options, numbers: PolicyGradientConfig) -> Float[Tensor, " P"]:
    """Mean over many batches of true returns, less the value of a critic fitted on other batches."""
    parts = []
    config = dataclasses.replace(numbers, budget=150)  # any baseline is unbiased
    for count, seed in _parts(options.reference_batches, 1_000_000):
        critic = fit_gaussian(batches(fixed, count, seed), config, "differences")
        new = batches(fixed, count, seed + 1)
        seen = GPValueEstimator(critic, new.policy, config.discount).evaluate(new.data)
        parts.append(ascent(new, new.true_return - seen.value))
    return torch.cat(parts).mean(0)


def _parts(total: int, first_seed: int) -> Iterator[tuple[int, int]]:
    """How many batches run side by side, and a seed, until all are done."""
    for done in range(0, total, SIDE_BY_SIDE):
        yield min(SIDE_BY_SIDE, total - done), first_seed + 10_000 * (done // SIDE_BY_SIDE)


def show(title: str, results: dict[str, Quality]) -> None:
    """Print the table of one policy."""
    print(f"\n{title}: batches of {EPISODES} × {STEPS} steps\n")
    print(f"| {'estimator':26s} | nsr (95 % interval)      | cosM | cosB | relMSE  |")
    print(f"|{'-' * 28}|--------------------------|------|------|---------|")
    for label, found in results.items():
        value, low, high = found.nsr.tolist()
        noise = f"{value:8.3g} ({low:.3g} to {high:.3g})"
        rest = f"{found.cos_mean[0]:.2f} | {found.cos_batch[0]:.2f} | {found.relative_mse[0]:7.3g}"
        print(f"| {label:26s} | {noise:24s} | {rest} |")


def write(results: dict[str, dict[str, Quality]], out: Path) -> None:
    """Leave the figures with their intervals as JSON, and a picture."""
    out.mkdir(parents=True, exist_ok=True)
    plain = {
        title: {
            label: {
                name: dict(zip(("value", "low", "high"), t.tolist(), strict=True))
                for name, t in q._asdict().items()
            }
            for label, q in table.items()
        }
        for title, table in results.items()
    }
    (out / "gradient_quality.json").write_text(json.dumps(plain, indent=2, ensure_ascii=False) + "\n")
    draw(results).savefig(out / "gradient_quality.png", dpi=150)
    print(f"\nfigures and picture are in {out}")


def draw(results: dict[str, dict[str, Quality]]) -> Figure:
    """One row of panels for each policy: noise, bias, and what a single batch is worth."""
    figure = Figure(figsize=(11, 4.2 * len(results)), layout="constrained")
    panels = figure.subplots(len(results), len(FIGURES), squeeze=False, sharey=True)
    for row, (title, table) in zip(panels, results.items(), strict=True):
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
