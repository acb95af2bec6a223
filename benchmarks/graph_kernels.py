"""Claim 5: do kernels on a graph of experience learn values with ridges and jumps better than others?

    python -m benchmarks.graph_kernels [--quick] [--seeds 20] [--out runs/graph-kernels]

Fixed policies on pendulum, cart-pole and Atwood's machine, their true values by brute force, the same
trajectories and budgets for every kernel, hyper-parameters by marginal likelihood. Leaves graph_kernels.json,
the surfaces of Fig. .3, the graph over the state plane and its connectivity in --out.
"""

import json
import math
import statistics
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.graph_arms import ARMS, EUCLIDEAN, TUNING_NODES, Tuned, grow, printed
from benchmarks.graph_machines import Atwood, CartPole, Jump, Spiral
from benchmarks.graph_pictures import draw_connectivity, draw_graph, draw_surfaces
from benchmarks.graph_systems import System, Trajectories, Truth, experience, true_values
from torch_gprl.gp import Posterior
from torch_gprl.graphs import NearestEdges, ThresholdEdges, TransitionGraph
from torch_gprl.graphs.edges import EdgeRule

TARGET_NOISE = 0.1  # standard deviation on targets, in those of the value
MODEL_ERROR = 1e-3  # variance that every predictive density has at least, in squared deviations of the value
MEMORY = 800  # basis vectors of the Euclidean kernel that remembers as much as a graph of visited states
NOISY_TORQUE = 0.7  # N m
THRESHOLDS = (0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4)  # of equation (.18)
PROBLEMS = (
    Jump(),
    Spiral(),
    Jump(NOISY_TORQUE, 40),
    CartPole(),
    Atwood(),
    Jump(action_values=True),
)


@dataclass(frozen=True)
class Options:
    """What to compare."""

    quick: bool = False  # 5 seeds and one budget: shows the order, not the error bars
    seeds: int = 20  # independent sets of trajectories
    budgets: tuple[int, ...] = (50, 100, 200)  # basis vectors
    trajectories: int = 60
    steps: int = 50  # transitions of each trajectory
    states: int = 1_500  # of true values: random ones, on the pendulum a grid of twice as many
    problems: tuple[str, ...] = ()  # names of those to look at; all unless told
    kernels: tuple[str, ...] = ()  # names of those to compare; all unless told
    tuning_steps: int = 30  # of the optimiser of the marginal likelihood
    out: Path = field(default_factory=lambda: Path("runs/graph-kernels"))  # where results go


@dataclass(frozen=True)
class Score:
    """Errors in standard deviations of the value, and seconds."""

    problem: str
    kernel: str
    budget: int
    seed: int
    rmse: float
    rmse_near: float  # within two cells of a discontinuity
    rmse_far: float
    nlpd: float  # negative log predictive density of the true value
    tuning: float  # s
    learning: float  # s
    predicting: float  # s, for the whole grid


def main(options: Options) -> None:
    """Run the comparison, print its table, leave JSON and pictures."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    seeds, budgets = (5, (100,)) if options.quick else (options.seeds, options.budgets)
    scores: list[Score] = []
    graphs: list[dict[str, object]] = []
    for problem in PROBLEMS:
        if options.problems and problem.name not in options.problems:
            continue
        torch.manual_seed(0)
        truth = true_values(problem, states_to_judge(problem, options.states))
        for seed in range(seeds):
            seen = experience(problem, truth, seed, options.trajectories, options.steps, TARGET_NOISE)
            surfaces, found = compare(problem, truth, seen, seed, budgets, options)
            scores += found
            print(f"{problem.name}, seed {seed}: {best(found)}", flush=True)
            if seed == 0:
                if is_plane(problem):
                    draw_surfaces(truth, surfaces, options.out / f"surfaces_{problem.file_name}.png")
                    draw_graph(truth, seen, options.out / f"graph_{problem.file_name}.png")
                graphs += connectivity(problem, seen)
                draw_connectivity(graphs, options.out / "connectivity.png")
        write(scores, graphs, options)
    show(scores)


def is_plane(problem: System) -> bool:
    """Whether the values are a picture over angle and speed."""
    return isinstance(problem, Jump) and not problem.action_values


def states_to_judge(problem: System, count: int) -> Tensor:
    """A grid over the plane, or random states."""
    if not is_plane(problem):
        return problem.sample(count)
    cells = math.isqrt(2 * count)
    lines = [torch.linspace(-extent, extent, cells, dtype=torch.float64) for extent in problem.extent]
    return torch.cartesian_prod(*lines)


def compare(
    problem: System,
    truth: Truth,
    seen: Trajectories,
    seed: int,
    budgets: tuple[int, ...],
    options: Options,
) -> tuple[dict[str, Tensor], list[Score]]:
    """All kernels on one set of trajectories: their surfaces at the largest budget, and their scores."""
    queries, noise = truth.points, TARGET_NOISE**2
    surfaces: dict[str, Tensor] = {}
    scores: list[Score] = []

    def keep(kernel: str, budget: int, posterior: Posterior, seconds: tuple[float, float, float]) -> None:
        surfaces[f"{kernel}, {MEMORY} kept" if budget == MEMORY else kernel] = posterior.mean
        scores.append(Score(problem.name, kernel, budget, seed, *errors(truth, posterior), *seconds))

    arms = {name: arm for name, arm in ARMS.items() if not options.kernels or name in options.kernels}
    for name, arm in arms.items():
        tuned = Tuned(arm, seen, seed, options.tuning_steps, noise)
        with_memory = {"Matérn 1/2": (*budgets, MEMORY)}
        for budget in with_memory.get(name, budgets):
            learned = tuned.learn(budget, seed)
            start = time.perf_counter()
            with torch.no_grad():
                posterior = learned.gp.posterior(queries)
            seconds = time.perf_counter() - start
            keep(name, budget, posterior, (learned.tuning, learned.learning, seconds))
    for extension in (".20", ".21"):
        for budget in budgets:
            start = time.perf_counter()
            posterior = printed(seen, queries, extension, noise, budget)
            keep(f"{extension} as printed", budget, posterior, (0.0, time.perf_counter() - start, 0.0))
    return surfaces, scores


def errors(truth: Truth, posterior: Posterior) -> tuple[float, float, float, float]:
    """RMSE over all states, near discontinuities and far from them, and negative log predictive density."""
    square = (posterior.mean - truth.values).square()
    variance = posterior.variance + MODEL_ERROR
    nlpd = 0.5 * (square / variance + (2 * math.pi * variance).log())
    parts = (square, square[truth.near], square[~truth.near])
    rmse, near, far = (float(part.mean().sqrt()) for part in parts)
    return rmse, near, far, float(nlpd.mean())


def best(scores: list[Score]) -> str:
    """The kernels with the smallest error, at the common budgets."""
    ranked = sorted((s for s in scores if s.budget != MEMORY), key=lambda s: s.rmse)
    return ", ".join(f"{s.kernel} at {s.budget}: {s.rmse:.3f}" for s in ranked[:3])


def show(scores: list[Score]) -> None:
    """Print means over seeds, and what each kernel gains over the best Euclidean one."""
    for problem, budget in dict.fromkeys((s.problem, s.budget) for s in scores):
        here = [s for s in scores if (s.problem, s.budget) == (problem, budget)]
        by_kernel = {
            name: [s for s in here if s.kernel == name] for name in dict.fromkeys(s.kernel for s in here)
        }
        rmses = [mean(by_kernel[name], "rmse") for name in EUCLIDEAN if name in by_kernel]
        euclidean = min(rmses, default=math.nan)
        columns = ("RMSE", "± seeds", "gain", "near", "far", "NLPD", "tune s", "learn s", "predict s")
        table = Table("kernel", *columns, title=f"{problem}, {budget} basis vectors")
        for name, runs in by_kernel.items():
            rmse = mean(runs, "rmse")
            spread = statistics.stdev(s.rmse for s in runs) if len(runs) > 1 else math.nan
            others = [f"{mean(runs, key):.3f}" for key in ("rmse_near", "rmse_far", "nlpd")]
            seconds = [f"{mean(runs, key):.2f}" for key in ("tuning", "learning", "predicting")]
            table.add_row(
                name, f"{rmse:.3f}", f"{spread:.3f}", f"{1 - rmse / euclidean:+.0%}", *others, *seconds
            )
        Console(width=140).print(table)


def connectivity(problem: System, seen: Trajectories) -> list[dict[str, object]]:
    """How sparse graphs of spread-out states are, and into how many parts they fall, by the rule of edges."""
    rules: dict[str, EdgeRule] = {f"threshold {t}": ThresholdEdges(t) for t in THRESHOLDS}
    rules["4 nearest"] = NearestEdges(4)
    found: list[dict[str, object]] = []
    for name, rule in rules.items():
        graph = TransitionGraph(seen.states.shape[-1], TUNING_NODES, rule)
        grow(graph, seen, torch.ones(len(seen.states), dtype=torch.bool))
        degree, parts = float(graph.degrees().double().mean()), int(graph.components())
        found.append({"problem": problem.name, "edges": name, "mean degree": degree, "parts": parts})
    return found


def mean(runs: list[Score], key: str) -> float:
    """Mean of one figure over seeds."""
    return statistics.fmean(getattr(score, key) for score in runs)


def write(scores: list[Score], graphs: list[dict[str, object]], options: Options) -> None:
    """Leave all figures with what they were made by."""
    settings = {key: value for key, value in asdict(options).items() if key != "out"}
    content = {"options": settings, "graphs": graphs, "scores": [asdict(score) for score in scores]}
    (options.out / "graph_kernels.json").write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
