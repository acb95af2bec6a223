"""Claims 1 and 2 as learning curves: one command runs every arm, same tasks, same seeds, and draws them.

    python -m experiments.policy_gradients --claim 1 [--task pendulum-swingup] [--learners 20]
    python -m experiments.policy_gradients --claim 2

Claim 1: Gaussian-process action values lower the variance of the gradient, hence speed up learning. The arms
are ways to weigh the scores. Claim 2: one process kept across policy updates, pruned by information and age,
beats one that is estimated anew at every update. The arms are weights of the age, and a process that keeps
its experience but solves it anew under each new policy. Metrics of every arm go to --out, where a later call
finds them; the means over learners and a picture to --results.
"""

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure

import envs
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.runs import MetricsWriter, bootstrap_interval, read_metrics, save_figure

Metrics = dict[str, Float[np.ndarray, "updates L"]]

# All experience solved at once, under today's policy, on a basis vector for every five steps.
AT_ONCE = {"targets": "differences", "replay": 4_000, "budget": 800, "noise": 0.1, "lengthscale": 0.5}
# The arms that matter most come first.
CLAIM_1: dict[str, dict[str, Any]] = {
    "REINFORCE": {"estimator": "return", "targets": "returns"},
    "return − batch mean": {"estimator": "mean-baseline", "targets": "returns"},
    "return − V_GP": {"estimator": "value-baseline", "targets": "returns"},
    "neural, generalised": {"estimator": "generalised", "trace": 0.8, "critic": "neural"},
    "GPTD, generalised": {"estimator": "generalised", "trace": 0.8, "targets": "differences"},
    "GPTD, all-action": {"estimator": "all-action", "targets": "differences"},
    "GPTD, all-action, replay": {"estimator": "all-action", **AT_ONCE},
    "the same, five steps": {"estimator": "all-action", "improvements": 4, "damping": 0.05, **AT_ONCE},
    "episodic natural": {"estimator": "return", "optimiser": "episodic-natural"},
    "(.7) as printed, k = 10": {"estimator": "k-step", "horizon": 10, "targets": "returns"},
    "k = 10 with baseline": {"estimator": "k-step-baseline", "horizon": 10, "targets": "returns"},
    "return − neural V": {"estimator": "value-baseline", "critic": "neural"},
    "GP, generalised": {"estimator": "generalised", "trace": 0.8, "targets": "returns"},
}
PERSISTENT = {"renew_every": 10**6, "targets": "differences", "budget": 100}
CLAIM_2: dict[str, dict[str, Any]] = {
    "estimated anew": PERSISTENT | {"renew_every": 1},
    "kept, λ = 0.0": PERSISTENT,
    "kept, solved anew": PERSISTENT | AT_ONCE,
    "newest rollout alone, solved at once": PERSISTENT | AT_ONCE | {"replay": 1_000},
    **{f"kept, λ = {weight}": PERSISTENT | {"age_weight": weight} for weight in (0.5, 1.0, 0.25, 0.75)},
}
PANELS = {
    "return": "return per episode",
    "gradient_cosine": "cosine of gradients from two halves",
    "value_error": "RMSE of Q right after a policy update",
    "explained_variance": "share of the variance of returns explained",
    "outdated": "share of basis vectors out of date",
}
SMOOTHED = 3  # updates


@dataclass(frozen=True)
class Options:
    """What to run."""

    claim: Literal[1, 2]  # of the thesis
    task: str = "pendulum-swingup"  # id of the task
    learners: int = 20  # independent learners of every arm
    num_envs: int = 5  # environments of each learner
    frames: int = 60_000  # environment steps per learner
    seed: int = 0  # of all arms
    most_arms: int = 99  # to run now; those that have run are read, and a later call goes on
    out: Path = Path("runs/policy-gradients")  # where metrics go
    results: Path = Path("experiments/results")  # where figures and picture go


def main(options: Options) -> None:
    """Run every arm of a claim that has not run yet, leave metrics, summary and picture."""
    torch.set_num_threads(1)
    folder = options.out / f"claim-{options.claim}-{options.task}"
    curves = {}
    left = options.most_arms
    for name, numbers in (CLAIM_1 if options.claim == 1 else CLAIM_2).items():
        place = folder / name.replace(" ", "-")
        metrics = recorded(place, options.frames)
        if metrics is None and not left:
            continue
        left -= metrics is None
        curves[name] = run(options, numbers, place) if metrics is None else metrics
        value, low, high = summary(curves[name]["return"], "return")
        print(f"{name:26s} return of the last tenth {value:8.1f} [{low:.1f}, {high:.1f}]", flush=True)
    figures = {
        name: {
            key: dict(zip(("mean", "low", "high"), summary(arm[key], key), strict=True))
            for key in PANELS
            if key in arm
        }
        for name, arm in curves.items()
    }
    options.results.mkdir(parents=True, exist_ok=True)
    result = options.results / f"claim_{options.claim}_{options.task.replace('-', '_')}.json"
    result.write_text(json.dumps(figures, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    save_figure(draw(curves, options.task), result.with_suffix(".png"))
    print(f"metrics are in {folder}, figures in {result} beside their picture")


def recorded(folder: Path, frames: int) -> Metrics | None:
    """The metrics of an earlier run of an arm, if it went as far."""
    if (folder / "metrics.csv").exists():
        metrics = read_metrics(folder / "metrics.csv")
        if metrics["frames"].max() >= frames:
            return metrics
        shutil.rmtree(folder)
    return None


def run(options: Options, numbers: dict[str, Any], folder: Path) -> Metrics:
    """One arm: its metrics by name."""
    env = envs.make(
        options.task, learners=options.learners, num_envs=options.num_envs, seed=options.seed, threads=1
    )
    config = dataclasses.replace(PolicyGradientConfig(total_frames=options.frames), **numbers)
    learner = PolicyGradient(env, config, seed=options.seed)
    folder.mkdir(parents=True, exist_ok=True)
    writer = MetricsWriter(folder / "metrics.csv", folder / "tensorboard")
    for figures in learner.train():
        writer.write(learner.updates, learner.frames, figures)
    writer.close()
    return read_metrics(folder / "metrics.csv")


def summary(metric: Float[np.ndarray, "updates L"], key: str) -> tuple[float, float, float]:
    """Mean over learners of the return at the end, and of other metrics in the second half; 95 % interval."""
    share = 10 if key == "return" else 2
    last = metric[-max(1, len(metric) // share) :].mean(axis=0)
    low, high = bootstrap_interval(last)
    return float(last.mean()), float(low), float(high)


def draw(curves: dict[str, Metrics], title: str) -> Figure:
    """One panel for each metric, one line with its interval for each arm; the last holds the legend."""
    figure = Figure(figsize=(14, 7.5), layout="constrained")
    figure.suptitle(title)
    *panels, legend = figure.subplots(2, 3).flat
    for axes, (key, label) in zip(panels, PANELS.items(), strict=True):
        for place, (name, arm) in enumerate(curves.items()):
            if key not in arm:
                continue
            smooth = _moving_mean(arm[key])
            frames = arm["frames"][len(arm["frames"]) - len(smooth) :, 0]
            low, high = bootstrap_interval(smooth)
            axes.plot(frames, smooth.mean(axis=1), color=f"C{place}", label=name, linewidth=1.5)
            axes.fill_between(frames, low, high, color=f"C{place}", alpha=0.2, linewidth=0)
        axes.set(xlabel="environment steps per learner", ylabel=label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    panels[list(PANELS).index("explained_variance")].set_ylim(-0.5, 1)  # an early critic is far below
    legend.axis("off")
    legend.legend(*panels[0].get_legend_handles_labels(), frameon=False, loc="center left")
    return figure


def _moving_mean(metric: Float[np.ndarray, "updates L"]) -> Float[np.ndarray, "smoothed L"]:
    """Mean of neighbouring updates; NaN where one has none."""
    windows = np.lib.stride_tricks.sliding_window_view(metric, min(SMOOTHED, len(metric)), axis=0)
    return windows.mean(axis=-1)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
