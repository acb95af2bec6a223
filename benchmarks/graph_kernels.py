"""Claim 5: do kernels on a graph of experience learn values with ridges and jumps better than others?

    python -m benchmarks.graph_kernels [--quick] [--seeds 20] [--minutes 8] [--out runs/graph-kernels]
    python -m benchmarks.graph_kernels --pictures [--out runs/graph-kernels]

Fixed policies on pendulum, cart-pole, Atwood's machine and in a maze, their true values by brute force, the
same trajectories and budgets for every kernel, hyper-parameters by marginal likelihood. Scores are appended
to scores.jsonl in --out; the same command goes on where it was stopped, and then sums up in
graph_kernels.json. --pictures draws the surfaces of Fig. .3, the graph over the plane and its connectivity.
"""

import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
import tyro
from torch import Tensor

from benchmarks.graph_arms import ARMS, TUNING_NODES, Tuned, grow, printed
from benchmarks.graph_machines import Atwood, CartPole, Jump, Spiral
from benchmarks.graph_maze import Maze
from benchmarks.graph_pictures import draw_connectivity, draw_graph, draw_surfaces
from benchmarks.graph_report import Score, show, write_summary
from benchmarks.graph_spread import error_file, keep_errors
from benchmarks.graph_systems import System, Trajectories, Truth, experience, true_values
from torch_gprl.gp import Posterior
from torch_gprl.graphs import NearestEdges, ThresholdEdges, TransitionGraph
from torch_gprl.graphs.edges import EdgeRule

TARGET_NOISE = 0.1  # standard deviation on targets, in those of the value
MODEL_ERROR = 1e-3  # variance that every predictive density has at least, in squared deviations of the value
PRINTED = {".20 as printed": ".20", ".21 as printed": ".21"}
NOISY_TORQUE = 0.7  # N m
THRESHOLDS = (0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4)  # of equation (.18)
PROBLEMS: tuple[System, ...] = (
    Jump(),
    Spiral(),
    Jump(NOISY_TORQUE, roll_outs=12),
    Jump(before=Jump(catch_angle=0.6)),
    CartPole(),
    Atwood(),
    Maze(),
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
    states: int = 1_500  # of true values: random ones, on a plane a grid of twice as many
    problems: tuple[str, ...] = ()  # names of those to look at; all unless told
    kernels: tuple[str, ...] = ()  # names of those to compare; all unless told
    tuning_steps: int = 30  # of the optimiser of the marginal likelihood
    minutes: float = math.inf  # after which to stop, to go on by the same command
    pictures: bool = False  # draw the first seed instead
    out: Path = field(default_factory=lambda: Path("runs/graph-kernels"))  # where results go


@dataclass(frozen=True)
class Learned:
    """What a kernel has learned at one budget, and in how many seconds."""

    kernel: str
    budget: int
    posterior: Posterior  # of the true states
    tuning: float
    learning: float
    predicting: float


def main(options: Options) -> None:
    """Run what is missing of the comparison and sum it up, or draw pictures."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    problems = [problem for problem in PROBLEMS if not options.problems or problem.name in options.problems]
    if options.pictures:
        return draw(problems, options)
    until = time.monotonic() + 60 * options.minutes
    records = options.out / "scores.jsonl"
    for problem in problems:
        complete(problem, records, until, options)
    scores = read_scores(records)
    write_summary(scores, options.out)
    show(scores, options.out)


def complete(problem: System, records: Path, until: float, options: Options) -> None:
    """Append the scores that are missing of a problem."""
    done = {(score.problem, score.kernel, score.seed) for score in read_scores(records)}
    missing = [
        (seed, kernel)
        for seed in range(5 if options.quick else options.seeds)
        for kernel in options.kernels or (*ARMS, *PRINTED)
        if (problem.name, kernel, seed) not in done
    ]
    if not missing or time.monotonic() > until:
        return
    truth = ground_truth(problem, options.states)
    for seed, kernel in missing:
        if time.monotonic() > until:
            return
        seen = experience(problem, truth, seed, options.trajectories, options.steps, TARGET_NOISE)
        learned = list(learn(kernel, truth, seen, seed, options))
        errors = {one.budget: one.posterior.mean - truth.values for one in learned}
        keep_errors(error_file(options.out, problem.name, kernel, seed), errors)
        found = [score(problem, truth, seed, one) for one in learned]
        with records.open("a") as file:
            file.write("".join(json.dumps(asdict(s), ensure_ascii=False) + "\n" for s in found))
        print(
            f"{problem.name}, seed {seed}, {kernel}: {', '.join(f'{s.rmse:.3f}' for s in found)}", flush=True
        )


def read_scores(records: Path) -> list[Score]:
    """All scores so far, each once."""
    lines = records.read_text().splitlines() if records.exists() else []
    scores = [Score(**json.loads(line)) for line in lines]
    return list({(s.problem, s.kernel, s.budget, s.seed): s for s in scores}.values())


def ground_truth(problem: System, states: int) -> Truth:
    """True values on a grid over the plane, or at random states."""
    torch.manual_seed(0)
    if not problem.axes or problem.action_values:
        return true_values(problem, problem.sample(states))
    cells = math.isqrt(2 * states)
    lines = [torch.linspace(-extent, extent, cells, dtype=torch.float64) for extent in problem.extent]
    return true_values(problem, torch.cartesian_prod(*lines))


def learn(kernel: str, truth: Truth, seen: Trajectories, seed: int, options: Options) -> Iterator[Learned]:
    """One kernel, tuned once, at every budget."""
    queries, noise = truth.points, TARGET_NOISE**2
    budgets = (100,) if options.quick else options.budgets
    if kernel in PRINTED:
        for budget in budgets:
            start = time.perf_counter()
            posterior = printed(seen, queries, PRINTED[kernel], noise, budget)
            yield Learned(kernel, budget, posterior, 0.0, time.perf_counter() - start, 0.0)
        return
    tuned = Tuned(ARMS[kernel], seen, seed, options.tuning_steps, noise)
    for group in tuned.together(ARMS[kernel].budgets or budgets):
        start = time.perf_counter()
        learned = tuned.learn(group, seed)
        middle = time.perf_counter()
        with torch.no_grad():
            posteriors = [gp.posterior(queries) for gp in learned]
        seconds = [s / len(group) for s in (middle - start, time.perf_counter() - middle)]
        for budget, posterior in zip(group, posteriors, strict=True):
            yield Learned(kernel, budget, posterior, tuned.seconds, *seconds)


def score(problem: System, truth: Truth, seed: int, learned: Learned) -> Score:
    """RMSE over all states, near discontinuities and far from them, and negative log predictive density."""
    posterior = learned.posterior
    square = (posterior.mean - truth.values).square()
    variance = posterior.variance + MODEL_ERROR
    nlpd = 0.5 * (square / variance + (2 * math.pi * variance).log())
    parts = square, square[truth.near], square[~truth.near]
    return Score(
        problem.name,
        learned.kernel,
        learned.budget,
        seed,
        *(float(part.mean().sqrt()) for part in parts),
        nlpd=float(nlpd.mean()),
        tuning=learned.tuning,
        learning=learned.learning,
        predicting=learned.predicting,
    )


def draw(problems: list[System], options: Options) -> None:
    """Pictures of the first seed: surfaces at the largest budget, graphs, and how connected they are."""
    graphs: list[dict[str, object]] = []
    for problem in problems:
        truth = ground_truth(problem, options.states)
        seen = experience(problem, truth, 0, options.trajectories, options.steps, TARGET_NOISE)
        graphs += connectivity(problem, seen)
        if problem.axes and not problem.action_values:
            surfaces: dict[str, Tensor] = {}
            for kernel in options.kernels or (*ARMS, *PRINTED):
                surfaces[kernel] = [*learn(kernel, truth, seen, 0, options)][-1].posterior.mean
            draw_surfaces(problem, truth, surfaces, options.out / f"surfaces_{problem.file_name}.png")
            draw_graph(problem, truth, seen, options.out / f"graph_{problem.file_name}.png")
    draw_connectivity(graphs, options.out / "connectivity.png")
    (options.out / "connectivity.json").write_text(json.dumps(graphs, indent=1, ensure_ascii=False) + "\n")


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


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
