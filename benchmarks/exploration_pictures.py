"""Pictures of `exploration`: Fig. .2, σ over the state plane as learning goes on, curves, visited states."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict
from torch import Tensor

from benchmarks.exploration_arms import CELLS, Outcome, Setting
from torch_gprl.learners import QLearning
from torch_gprl.policies import ConfidenceNoise, GibbsPolicy

GRID = 41  # points of a map in each direction
MOMENTS = 4  # maps of σ
SAMPLES = 400  # actions over the density
DIMS = {"pendulum-explore": 3, "MountainCarContinuous-v0": 2}


class Snapshots:
    """Maps of the first learner while it learns: σ over the plane, and the value beside the density.

    Args:
        setting: task and plane; maps are drawn where two coordinates fix the observation.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.taken: dict[str, Any] = {}

    @torch.no_grad()
    def take(self, learner: QLearning) -> None:
        """Add what can be seen now."""
        if self.setting.task not in DIMS or not learner.teacher.taught:
            return
        explorer = learner.policy.policy
        if isinstance(explorer, ConfidenceNoise):
            states = self._everyone(learner, self._plane())
            _, std = explorer.head.parameters_at(states)
            width = (learner.maximiser.high - learner.maximiser.low).item() / 2
            self.taken.setdefault("sigma", []).append(std[0, :, 0].reshape(GRID, GRID).float() / width)
            self.taken.setdefault("frames", []).append(learner.frames)
        elif isinstance(explorer, GibbsPolicy) and learner.frames <= self.setting.frames / 2:
            self.taken["figure 2"] = self._value_and_density(learner, explorer)

    def _plane(self) -> Tensor:
        """Points of the plane [GRID², 2], the first coordinate first."""
        axes = (torch.linspace(a, b, GRID) for a, b in zip(self.setting.low, self.setting.high, strict=True))
        return torch.cartesian_prod(*axes)

    def _observations(self, points: Tensor) -> Tensor:
        if self.setting.task == "pendulum-explore":
            θ, ω = points.unbind(-1)
            return torch.stack([θ.cos(), θ.sin(), ω], -1)
        return points

    def _everyone(self, learner: QLearning, points: Tensor) -> Tensor:
        """The same states for every learner."""
        return self._observations(points).expand(learner.learners, -1, -1)

    def _value_and_density(self, learner: QLearning, explorer: GibbsPolicy) -> dict[str, Tensor]:
        """Q and π over the first coordinate and the action, the second coordinate zero."""
        first = torch.linspace(self.setting.low[0], self.setting.high[0], GRID)
        points = torch.stack([first, torch.zeros(GRID)], -1)
        states = self._everyone(learner, points)
        grid = explorer.head.cover.candidates
        data = TensorDict({"observation": states}, states.shape[:2])
        density = explorer.get_dist(data)
        shares = torch.stack(
            [density.log_prob(action.expand(*states.shape[:2], 1)).exp()[0] for action in grid], -1
        )
        low, high = self.setting.low[0], self.setting.high[0]
        anywhere = torch.stack([low + (high - low) * torch.rand(SAMPLES), torch.zeros(SAMPLES)], -1)
        many = self._everyone(learner, anywhere)
        drawn = explorer.get_dist(TensorDict({"observation": many}, many.shape[:2])).sample()[0, :, 0]
        angle = self.setting.place(many[0])[:, 0]
        value = explorer.head.opinion(states, explorer.head.mean_at(states), states[..., :0])["preference"][0]
        return {
            "first": first,
            "action": grid[:, 0],
            "value": value,
            "density": shares,
            "samples": torch.stack([angle, drawn.float()], -1),
        }


def draw(
    setting: Setting, outcomes: dict[str, Outcome], pictures: dict[str, dict[str, Any]], out: Path
) -> None:
    """All pictures of a task, as far as arms are done."""
    draw_curves(setting, outcomes, out / f"{setting.task}-curves.png")
    draw_visits(setting, outcomes, out / f"{setting.task}-visits.png")
    for arm, taken in pictures.items():
        name = f"{setting.task}-{arm.replace(' ', '-')}"
        if "sigma" in taken:
            draw_sigma(setting, taken, out / f"{name}-sigma.png")
        if "figure 2" in taken:
            draw_density(setting, taken["figure 2"], arm, out / f"{name}-density.png")


def draw_curves(setting: Setting, outcomes: dict[str, Outcome], path: Path) -> None:
    """Mean return of the greedy policy, and σ, against environment steps."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    returns, sigma = figure.subplots(1, 2)
    for index, (arm, outcome) in enumerate(outcomes.items()):
        style = {"label": arm, "color": f"C{index % 10}", "linestyle": "-" if index < 10 else "--"}
        returns.plot(outcome.frames, outcome.returns.mean(0), **style)
        steps = np.linspace(0, outcome.frames[-1], outcome.sigma.shape[1])
        sigma.plot(steps, outcome.sigma.square().mean(0).sqrt(), **style)
    returns.axhline(setting.threshold, color="0.7", linewidth=1)
    returns.set(xlabel="environment steps", ylabel="return of the greedy policy", title=setting.task)
    sigma.set(xlabel="environment steps", ylabel="distance to the greedy action\n(halves of the range, rms)")
    returns.legend(fontsize="x-small")
    figure.savefig(path, dpi=110)


def draw_visits(setting: Setting, outcomes: dict[str, Outcome], path: Path) -> None:
    """How often each cell of the plane was visited, by arm."""
    columns = 4
    rows = -(-len(outcomes) // columns)
    figure = Figure(figsize=(3 * columns, 2.6 * rows), layout="constrained")
    panels = np.ravel(figure.subplots(rows, columns))
    for axes in panels[len(outcomes) :]:
        axes.set_axis_off()
    for axes, (arm, outcome) in zip(panels, outcomes.items(), strict=False):
        points = outcome.states.flatten(0, 1).numpy()
        counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=CELLS, range=((0, 1), (0, 1)))
        _map(axes, setting, np.log1p(counts))
        axes.set_title(arm, fontsize="small")
    figure.supxlabel(setting.labels[0])
    figure.supylabel(setting.labels[1])
    figure.savefig(path, dpi=110)


def draw_sigma(setting: Setting, taken: dict[str, Any], path: Path) -> None:
    """σ over the plane at some moments of the first learner's life."""
    chosen = np.unique(np.linspace(0, len(taken["sigma"]) - 1, MOMENTS).round().astype(int))
    figure = Figure(figsize=(3.2 * len(chosen), 3), layout="constrained")
    panels = np.ravel(figure.subplots(1, len(chosen)))
    for axes, index in zip(panels, chosen, strict=True):
        image = _map(axes, setting, taken["sigma"][index].numpy(), vmin=0, vmax=1)
        axes.set_title(f"{taken['frames'][index]:,} steps", fontsize="small")
    figure.colorbar(image, ax=list(panels), label="σ (halves of the range)")
    figure.supxlabel(setting.labels[0])
    figure.supylabel(setting.labels[1])
    figure.savefig(path, dpi=110)


def draw_density(setting: Setting, taken: dict[str, Tensor], arm: str, path: Path) -> None:
    """Fig. .2: value and selection density side by side, with samples overlaid.

    The value is scaled by its range over the actions of each state, the density by its peak there.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    x, y = taken["first"].numpy(), taken["action"].numpy()
    for axes, name in zip(figure.subplots(1, 2), ("value", "density"), strict=True):
        relative = taken[name] / taken[name].amax(1, keepdim=True)
        image = axes.pcolormesh(x, y, relative.mT.numpy(), shading="nearest")
        figure.colorbar(image, ax=axes)
        axes.plot(*taken["samples"].mT.numpy(), ".", color="white", markersize=1.5)
        axes.set(xlabel=setting.labels[0], ylabel="action", title=f"{arm}: {name}")
    figure.savefig(path, dpi=110)


def _map(axes: Axes, setting: Setting, values: np.ndarray, **limits: float) -> Any:  # noqa: ANN401
    """Values [first, second] over the plane."""
    extent = (setting.low[0], setting.high[0], setting.low[1], setting.high[1])
    return axes.imshow(values.T, origin="lower", extent=extent, aspect="auto", **limits)
