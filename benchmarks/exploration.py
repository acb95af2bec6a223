"""Claims 3 and 4: does exploration that asks the critic find rewards sooner than tuned noise?

    python -m benchmarks.exploration [--learner q-learning] [--tasks atwood] [--arms confidence] [--quick]

Every arm has the same learner, environments and starts, learner by learner, so that arms are compared in
pairs. The tuned noise is the best of five standard deviations on the very same seeds, which favours it. Each
finished group of learners is kept in --out; a second call runs what is missing. Leaves exploration.json and
pictures there.
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.stats import wilcoxon

from benchmarks.exploration_arms import ARMS, GAUSSIAN, MATCHED, SETTINGS, Outcome, Setting, run
from benchmarks.exploration_pictures import Snapshots, draw

SHOWN = ("steps to threshold", "steps to discovery", "final return", "time in goal", "entropy of cells")
GROUP = 5  # learners of one program
QUICK_LEARNERS, QUICK_SHARE = 4, 5  # learners, and the part of the steps that a quick run takes


@dataclass(frozen=True)
class Options:
    """What to compare."""

    learner: Literal["q-learning", "dynamic-programming"] = "dynamic-programming"  # what all arms share
    tasks: tuple[str, ...] = ()  # all of the learner's unless named
    arms: tuple[str, ...] = ()  # all of the learner's unless named
    learners: int = 20  # paired seeds
    first: int = 0  # the first of them: numbers that were chosen on some seeds are judged on others
    quick: bool = False  # a fifth of the steps, four learners: shows that it works, not who wins
    out: Path = field(default_factory=lambda: Path("runs/exploration"))  # where results go


def main(options: Options) -> None:
    """Run what is missing, print the table, leave JSON and pictures."""
    torch.set_num_threads(1)
    settings, arms = SETTINGS[options.learner], (*ARMS[options.learner], MATCHED)
    unknown = {*options.tasks} - {*settings} | {*options.arms} - {*arms}
    if unknown:
        known = ", ".join((*settings, *arms))
        raise SystemExit(f"unknown task or arm: {', '.join(unknown)}; choose from {known}")
    if options.quick:
        options = dataclasses.replace(options, learners=QUICK_LEARNERS, out=options.out / "quick")
    options.out.mkdir(parents=True, exist_ok=True)
    for task in options.tasks or settings:
        setting = settings[task]
        with Progress() as progress:
            for arm in options.arms or arms:
                complete(setting, arm, options, progress)
        report(setting, options.out)


def record_of(setting: Setting, arm: str, first: int, out: Path) -> Path:
    """Where a finished group of learners is kept, by its first one."""
    return out / f"{setting.learner} {setting.name} {arm} {first}.pt"


def complete(setting: Setting, arm: str, options: Options, progress: Progress) -> None:
    """Run the groups of an arm that are missing; the matched one waits for what it is matched with."""
    frames = setting.frames // (QUICK_SHARE if options.quick else 1)
    numbers = ARMS[setting.learner].get(arm)
    if numbers is None:
        σ = realised_sigma(setting, "confidence", options.out)
        if σ is None:
            return
        numbers = {"exploration": "gaussian", "std": matching_std(setting, σ, options.out)}
    last = options.first + options.learners
    for first in range(options.first, last, GROUP):
        path = record_of(setting, arm, first, options.out)
        if path.exists():
            continue
        learners = range(first, min(first + GROUP, last))
        bar = progress.add_task(f"{setting.name}, {arm}, learner {first} and on", total=frames)
        pictures = Snapshots(setting)
        for learner, outcome in run(setting, numbers, learners, frames):
            progress.update(bar, completed=learner.frames)
            pictures.take(learner)
            kept = {"outcome": dataclasses.asdict(outcome), "pictures": pictures.taken, "numbers": numbers}
        torch.save(kept, path.with_suffix(".part"))
        path.with_suffix(".part").replace(path)


def realised_sigma(setting: Setting, arm: str, out: Path) -> float | None:
    """Root mean square distance to the greedy action, in halves of the range; none before the arm has run."""
    kept = load(setting, arm, out)
    return None if kept is None else kept[0].measures(setting)["mean sigma"].square().mean().sqrt().item()


def matching_std(setting: Setting, sigma: float, out: Path) -> float:
    """The standard deviation whose noise comes to `sigma` once the box has clipped it.

    Interpolates between the gaussian arms that have run; `sigma` itself if none has.
    """
    realised = {arm: realised_sigma(setting, arm, out) for arm in GAUSSIAN}
    known = sorted((found, GAUSSIAN[arm]["std"]) for arm, found in realised.items() if found is not None)
    if not known:
        return sigma
    return float(np.interp(sigma, *zip((0.0, 0.0), *known, strict=True)))


def load(setting: Setting, arm: str, out: Path) -> tuple[Outcome, dict[str, Any]] | None:
    """What the finished groups of an arm did, and the pictures of the first; none if there is no group."""
    paths = sorted(
        out.glob(f"{setting.learner} {setting.name} {arm} [0-9]*.pt"),
        key=lambda path: int(path.stem.split()[-1]),
    )
    groups = [torch.load(path, weights_only=True) for path in paths]
    if not groups:
        return None
    parts = [Outcome(**group["outcome"]) for group in groups]
    return Outcome.of_all(parts), groups[0]["pictures"]


def report(setting: Setting, out: Path) -> None:
    """Table, JSON and pictures of all arms of a task that are done."""
    tried = {arm: load(setting, arm, out) for arm in (*ARMS[setting.learner], MATCHED)}
    loaded = {arm: kept for arm, kept in tried.items() if kept is not None}
    measures = {arm: outcome.measures(setting) for arm, (outcome, _) in loaded.items()}
    noises = [arm for arm in GAUSSIAN if arm in measures]
    # the best σ: the earliest on average, then the best at the end
    tuned = min(noises, key=lambda arm: _rank(measures[arm]), default=None)
    found = {arm: summarise(one, measures.get(tuned or "")) for arm, one in measures.items()}
    _show(setting, found, tuned)
    path = out / "exploration.json"
    everything = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    everything.setdefault(setting.learner, {})[setting.name] = {"tuned": tuned, "arms": found}
    path.write_text(json.dumps(everything, indent=2) + "\n", encoding="utf-8")
    draw(
        setting,
        {arm: outcome for arm, (outcome, _) in loaded.items()},
        {arm: pictures for arm, (_, pictures) in loaded.items()},
        out,
    )


def _rank(measured: dict[str, torch.Tensor]) -> tuple[float, float]:
    return measured["steps to threshold"].mean().item(), -measured["final return"].mean().item()


def summarise(
    measured: dict[str, torch.Tensor], baseline: dict[str, torch.Tensor] | None
) -> dict[str, dict[str, float | Sequence[float]]]:
    """Mean, median and values of each measure, with a paired test against the baseline."""
    return {
        name: {
            "mean": values.mean().item(),
            "median": values.median().item(),
            "p": _paired(values, baseline[name]) if baseline else 1.0,
            "values": [float(f"{value:.4g}") for value in values.tolist()],
        }
        for name, values in measured.items()
    }


def _paired(values: torch.Tensor, baseline: torch.Tensor) -> float:
    """Wilcoxon's signed-rank test of paired seeds, two-sided; 1 if nothing differs."""
    pairs = min(len(values), len(baseline))  # an arm may still miss a group
    difference = (values[:pairs] - baseline[:pairs]).numpy()
    return float(wilcoxon(difference).pvalue) if difference.any() else 1.0  # pyright: ignore[reportAttributeAccessIssue]


def _show(setting: Setting, found: dict[str, dict[str, Any]], tuned: str | None) -> None:
    table = Table(title=f"{setting.learner} on {setting.name}: means (p against {tuned}, paired)")
    table.add_column("arm")
    for name in SHOWN:
        table.add_column(name)
    for arm, measured in found.items():
        cells = (f"{measured[name]['mean']:.3g} ({measured[name]['p']:.2g})" for name in SHOWN)
        table.add_row(arm, *cells)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options))
