"""GP Q-learning against tabular Q-learning at equal experience: same task, same learners, greedy evaluations.

    python -m experiments.q_learning [--task pendulum-swingup] [--learners 20] [--frames 5000]

The arms are the thesis' online GP Q-learning, fitted Q iteration on the same Gaussian process, and tables of
three resolutions. Leaves summary.json with every evaluation, and a picture of the learning curves. A rerun
with the same numbers skips the arms that it finds there.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModuleBase

import envs
from experiments.tabular import Grid, TabularQ
from torch_gprl.learners import QLearning, QLearningConfig
from torch_gprl.runs import bootstrap_interval, evaluate, save_figure

GRIDS = {"coarse": Grid(8, 3), "medium": Grid(16, 5), "fine": Grid(32, 9)}
EVALUATION_SEED = 1_000_000


@dataclass(frozen=True)
class Options:
    """What to run."""

    task: str = "pendulum-swingup"  # with a picture plane and one action
    learners: int = 20  # independent learners of every arm
    frames: int = 5_000  # environment steps per learner
    every: int = 500  # environment steps between evaluations
    episodes: int = 5  # of an evaluation, for each learner
    discount: float = 0.95  # γ per environment step
    seed: int = 0  # of all arms
    most_arms: int = 99  # to run now; a later call goes on
    out: Path = Path("runs/q-learning")  # where results go


class Learner(Protocol):
    """What every arm is."""

    @property
    def frames(self) -> int:
        """Environment steps per learner so far."""
        ...

    @property
    def policy(self) -> TensorDictModuleBase:
        """What it would do now."""
        ...

    def train(self) -> Iterator[object]:
        """Stops now and then."""
        ...


def arms(options: Options) -> dict[str, Callable[[envs.BatchEnv], Learner]]:
    """Every way to learn, by name."""

    def gaussian(**numbers: object) -> Callable[[envs.BatchEnv], Learner]:
        config = QLearningConfig(
            total_frames=options.frames,
            discount=options.discount,
            **numbers,  # pyright: ignore[reportArgumentType]
        )
        return lambda env: QLearning(env, config, seed=options.seed)

    def table(grid: Grid) -> Callable[[envs.BatchEnv], Learner]:
        return lambda env: TabularQ(env, grid, options.frames, options.discount, seed=options.seed)

    return {
        "GP, online": gaussian(targets="online"),
        "GP, fitted": gaussian(targets="fitted"),
        **{f"table, {name}: {grid.cells}² × {grid.actions}": table(grid) for name, grid in GRIDS.items()},
    }


def run(
    options: Options, make: Callable[[envs.BatchEnv], Learner]
) -> Float[np.ndarray, "evaluations learners"]:
    """Mean return of the greedy policy of every learner, every so many steps."""
    env = envs.make(options.task, learners=options.learners, num_envs=1, seed=options.seed, threads=1)
    learner, returns, stop = make(env), [], options.every
    for _ in learner.train():
        if learner.frames >= stop:
            test = envs.make(
                options.task,
                learners=options.learners,
                num_envs=options.episodes,
                seed=EVALUATION_SEED,
                threads=1,
            )
            returns.append(evaluate(test, learner.policy).mean(1).numpy())
            stop += options.every
    return np.stack(returns)


def draw(frames: Float[np.ndarray, " evaluations"], curves: dict[str, np.ndarray], title: str) -> Figure:
    """Means over learners with their 95 % intervals."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for name, returns in curves.items():
        low, high = bootstrap_interval(returns)
        (line,) = axes.plot(frames, returns.mean(1), label=name)
        axes.fill_between(frames, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="environment steps per learner", ylabel="return of the greedy policy", title=title)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small")
    return figure


def main(options: Options) -> None:
    """Run the arms that are missing, leave summary and picture."""
    torch.set_num_threads(1)
    folder = options.out / options.task
    folder.mkdir(parents=True, exist_ok=True)
    curves, left = recorded(folder / "summary.json", options), options.most_arms
    for name, make in arms(options).items():
        if name not in curves and left:
            left -= 1
            curves[name] = run(options, make)
            write(folder, options, curves)
        if name in curves:
            low, high = bootstrap_interval(curves[name][-1])
            print(
                f"{name:28s} final return {curves[name][-1].mean():8.1f} [{low:.1f}, {high:.1f}]", flush=True
            )
    print(f"everything is in {folder}")


def numbers(options: Options) -> dict[str, object]:
    """Options that change what an arm learns."""
    return {name: value for name, value in asdict(options).items() if name not in ("out", "most_arms")}


def recorded(summary: Path, options: Options) -> dict[str, np.ndarray]:
    """The curves of an earlier call with the same numbers."""
    if not summary.exists():
        return {}
    earlier = json.loads(summary.read_text(encoding="utf-8"))
    if earlier["options"] != numbers(options):
        return {}
    return {name: np.array(returns) for name, returns in earlier["returns"].items()}


def write(folder: Path, options: Options, curves: dict[str, np.ndarray]) -> None:
    """The summary, and the picture of the learning curves."""
    frames = options.every * np.arange(1.0, len(next(iter(curves.values()))) + 1)
    result = {
        "options": numbers(options),
        "frames": frames.tolist(),
        "returns": {name: returns.tolist() for name, returns in curves.items()},
    }
    (folder / "summary.json").write_text(json.dumps(result, ensure_ascii=False) + "\n", encoding="utf-8")
    save_figure(draw(frames, curves, options.task), folder / "curves.png")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
