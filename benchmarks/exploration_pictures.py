"""Pictures of `exploration`: Fig. .2, σ over the state plane as learning goes on, curves, visited states."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict
from torch import Tensor

from benchmarks.exploration_arms import CELLS, Learner, Outcome, Setting
from torch_gprl.learners import DynamicProgramming, QLearning
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
        self._moment = -1

    @torch.no_grad()
    def take(self, learner: Learner) -> None:
        """Add what can be seen now, once in each part of the training that has its own map."""
        moment = learner.frames * MOMENTS // self.setting.frames
        knows = learner.critic.planned if isinstance(learner, DynamicProgramming) else learner.teacher.taught
        if self.setting.task not in DIMS or moment == self._moment or not knows:
            return
        self._moment = moment
        if isinstance(learner, DynamicProgramming):
            self._take_plan(learner)
        else:
            self._take_critic(learner)

    def _take_critic(self, learner: QLearning) -> None:
        explorer = learner.policy.policy
        if isinstance(explorer, ConfidenceNoise):
            states = self._everyone(learner, self._plane())
            _, std = explorer.head.parameters_at(states)
            width = (learner.maximiser.high - learner.maximiser.low).item() / 2
            self._keep_sigma(std / width, learner.frames)
        elif isinstance(explorer, GibbsPolicy) and self._early(learner):
            self.taken["figure 2"] = self._value_and_density(learner, explorer)

    def _take_plan(self, learner: DynamicProgramming) -> None:
        behaviour, plan = learner.policy.behaviour, learner.critic
        if behaviour.exploration == "confidence":
            states = self._everyone(learner, self._plane()).double()
            self._keep_sigma(learner.policy.std_at(states, plan.best_action(states, True)), learner.frames)
        elif behaviour.exploration == "gibbs" and self._early(learner):
            first, points = self._line()
            states = self._everyone(learner, points).double()
            self.taken["figure 2"] = self._panels(
                first,
                plan.acting_actions[:, 0] * (learner.env.action_spec.space.high.flatten()[0]),
                plan.candidate_values(states, explore=True)[0],
                learner.policy.gibbs_shares(states)[0],
            )

    def _early(self, learner: Learner) -> bool:
        return learner.frames <= self.setting.frames / 2

    def _keep_sigma(self, std: Tensor, frames: int) -> None:
        """σ of the first learner [L, GRID², 1], in halves of the range."""
        self.taken.setdefault("sigma", []).append(std[0, :, 0].reshape(GRID, GRID).float())
        self.taken.setdefault("frames", []).append(frames)

    def _plane(self) -> Tensor:
        """Points of the plane [GRID², 2], the first coordinate first."""
        axes = (torch.linspace(a, b, GRID) for a, b in zip(self.setting.low, self.setting.high, strict=True))
        return torch.cartesian_prod(*axes)

    def _observations(self, points: Tensor) -> Tensor:
        if self.setting.task == "pendulum-explore":
            θ, ω = points.unbind(-1)
            return torch.stack([θ.cos(), θ.sin(), ω], -1)
        return points

    def _everyone(self, learner: Learner, points: Tensor) -> Tensor:
        """The same states for every learner."""
        return self._observations(points).expand(learner.learners, -1, -1)

    def _line(self) -> tuple[Tensor, Tensor]:
        """Places along the first coordinate, and the points there, the second coordinate zero."""
        first = torch.linspace(self.setting.low[0], self.setting.high[0], GRID)
        return first, torch.stack([first, torch.zeros(GRID)], -1)

    def _value_and_density(self, learner: QLearning, explorer: GibbsPolicy) -> dict[str, Tensor]:
        """Q and π over the first coordinate and the action."""
        first, points = self._line()
        states = self._everyone(learner, points)
        grid = explorer.head.cover.candidates
        density = explorer.get_dist(TensorDict({"observation": states}, states.shape[:2]))
        shares = torch.stack(
            [density.log_prob(action.expand(*states.shape[:2], 1)).exp()[0] for action in grid], -1
        )
        value = explorer.head.opinion(states, explorer.head.mean_at(states), states[..., :0])["preference"][0]
        return self._panels(first, grid[:, 0], value, shares)

    def _panels(self, first: Tensor, action: Tensor, value: Tensor, density: Tensor) -> dict[str, Tensor]:
        """Value and density [GRID, J] with actions drawn from the density, a few at each place."""
        drawn = torch.multinomial(density, SAMPLES // GRID, replacement=True)
        places = first.unsqueeze(-1).expand(drawn.shape)
        samples = torch.stack([places.float(), action.float()[drawn]], -1).flatten(0, 1)
        least, most = value.aminmax(dim=-1, keepdim=True)
        value = (value - least) / (most - least).clamp_min(torch.finfo(value.dtype).tiny)
        return {"first": first, "action": action, "value": value, "density": density, "samples": samples}


def draw(
    setting: Setting, outcomes: dict[str, Outcome], pictures: dict[str, dict[str, Any]], out: Path
) -> None:
    """All pictures of a task, as far as arms are done."""
    draw_curves(setting, outcomes, out / f"{setting.learner}-{setting.name}-curves.png")
    draw_visits(setting, outcomes, out / f"{setting.learner}-{setting.name}-visits.png")
    for arm, taken in pictures.items():
        name = f"{setting.learner}-{setting.name}-{arm.replace(' ', '-')}"
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
    returns.set(
        xlabel="environment steps",
        ylabel="return of the greedy policy",
        title=f"{setting.learner} on {setting.name}",
    )
    sigma.set(xlabel="environment steps", ylabel="distance to the greedy action\n(halves of the range, rms)")
    returns.legend(fontsize="x-small")
    figure.savefig(path, dpi=110)


def draw_visits(setting: Setting, outcomes: dict[str, Outcome], path: Path) -> None:
    """How often each cell of the plane was visited, by arm."""
    rows = -(-len(outcomes) // 4)
    columns = -(-len(outcomes) // rows)
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
    most = max(taken["sigma"][index].max().item() for index in chosen)
    for axes, index in zip(panels, chosen, strict=True):
        image = _map(axes, setting, taken["sigma"][index].numpy(), vmin=0, vmax=most)
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
