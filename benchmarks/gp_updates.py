"""How fast Gaussian processes learn from a stream and predict, and how well: ours beside its peers.

    python -m benchmarks.gp_updates [--quick] [--out FILE]

One thread, float64. Every peer gets the same data, hyper-parameters and budget; they take turns in rounds,
and medians count. Prints tables, writes them as JSON, and draws them in a picture of the same name.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from threadpoolctl import threadpool_limits

from benchmarks import gp_report
from benchmarks.gp_peers import OURS, PEERS, WINDOWS, Peer, Sparse, accuracy
from benchmarks.streams import STREAMS, Stream, novel, pendulum, uniform
from benchmarks.timing import machine, matrix_product, rates

BUDGET, BLOCK = 200, 32
LEARNER_BUDGET = 100
NEVER = 1e12  # a novelty threshold that no point exceeds: the basis is settled
Row = dict[str, str | float]


@dataclass(frozen=True)
class Effort:
    """How much of everything is measured."""

    turn: float = 0.15  # seconds that a competitor gets in each round
    rounds: int = 5
    points: int = 20_000  # length of the streams; who gets through starts again
    common: int = 4_000  # points that every peer has learned when speeds, and first errors, are compared
    seeds: int = 4  # draws of each stream over which accuracies are averaged
    patience: float = 8.0  # seconds after which a peer is left out of a measurement it cannot get ready for
    budgets: tuple[int, ...] = (50, 100, 200, 500, 1000)
    blocks: tuple[int, ...] = (1, 8, 32, 128, 1000)
    dims: tuple[int, ...] = (3, 8, 16, 23)
    learners: tuple[int, ...] = (1, 4, 16, 64)
    settled: tuple[tuple[int, int], ...] = (
        (200, 1),
        (200, 32),
        (200, 256),
        (200, 1000),
        (50, 1000),
        (1000, 1000),
    )


QUICK = Effort(
    turn=0.03,
    rounds=3,
    points=4_000,
    common=800,
    seeds=1,
    patience=2.0,
    budgets=(50, 200),
    blocks=(1, 32, 256),
    dims=(3, 23),
    learners=(1, 64),
    settled=((200, 1), (200, 32), (200, 1000)),
)


@dataclass
class Options:
    """Compare Gaussian processes on streams."""

    quick: bool = False  # a rough answer in half a minute
    out: Path = field(default=Path("benchmarks/results/gp_updates.json"))  # the picture goes beside it


class Feed:
    """Gives a peer its stream block by block, over and over; a call is one block."""

    def __init__(self, peer: Peer, stream: Stream) -> None:
        self.peer, self.stream = peer, stream
        self.seen, self.block = 0, BLOCK

    def __call__(self) -> int:
        """Learn from the next block; returns its number of points."""
        start = self.seen % (self.stream.targets.shape[-1] - self.block + 1)
        chosen = slice(start, start + self.block)
        self.peer.update(self.stream.inputs[..., chosen, :], self.stream.targets[..., chosen])
        self.seen += self.block
        return self.block

    def until(self, points: int, patience: float) -> bool:
        """Learn from at least so many points; False if that took longer than `patience` seconds."""
        deadline = time.perf_counter() + patience
        while self.seen < points:
            if time.perf_counter() > deadline:
                return False
            self()
        return True


def prepared(stream: Stream, budget: int, points: int, patience: float) -> dict[str, Feed]:
    """The peers that learned from so many points within `patience` seconds."""
    feeds = {peer: Feed(make(stream, budget), stream) for peer, make in PEERS.items()}
    return {peer: feed for peer, feed in feeds.items() if feed.until(points, patience)}


def compare_streams(effort: Effort) -> Iterator[Row]:
    """Speed of every peer on every stream."""
    for name, make in STREAMS.items():
        stream = make(effort.points)
        ready = prepared(stream, BUDGET, effort.common, effort.patience)
        speed = rates(ready, effort.rounds, effort.turn)
        for peer in ready:
            yield {
                "stream": name,
                "peer": peer,
                "updates_per_second": speed[peer],
                "ratio": speed[OURS] / speed[peer],
            }


def compare_accuracy(effort: Effort) -> Iterator[Row]:
    """Errors and densities of every peer early and late in every stream, in the mean over its draws."""
    for name, make in STREAMS.items():
        for points in (effort.common, effort.points):
            draws = [make(points, seed) for seed in range(effort.seeds)]
            for peer in PEERS:
                if peer == "textbook recursion":  # slow, and in place it has the same numbers
                    continue
                scores = [accuracy(_to_the_end(peer, stream), stream) for stream in draws]
                rmse, nlpd = (sum(values) / len(draws) for values in zip(*scores, strict=True))
                row: Row = {"stream": name, "points": points, "peer": peer, "seeds": effort.seeds}
                yield {**row, "rmse": rmse, "nlpd": nlpd}


def _to_the_end(peer: str, stream: Stream) -> Peer:
    feed = Feed(PEERS[peer](stream, BUDGET), stream)
    if peer in WINDOWS:  # earlier points leave no trace
        feed.seen = max(0, len(stream.targets) // BLOCK - 2 * BUDGET // BLOCK) * BLOCK
    feed.until(len(stream.targets) // BLOCK * BLOCK, patience=math.inf)
    return feed.peer


def compare_over(effort: Effort, variable: str, values: Sequence[int]) -> Iterator[Row]:
    """Speed of every peer with a full basis, as one of budget, block and dims varies."""
    setting = {"budget": BUDGET, "block": BLOCK, "dims": 8}
    for value in values:
        now = {**setting, variable: value}
        stream = uniform(effort.points, now["dims"]) if variable == "dims" else novel(effort.points)
        ready = prepared(stream, now["budget"], now["budget"] * 5 // 4, effort.patience)
        if now["block"] > now["budget"]:  # a window would throw points away unseen
            ready = {peer: feed for peer, feed in ready.items() if peer not in WINDOWS}
        for feed in ready.values():
            feed.block = now["block"]
        speed = rates(ready, effort.rounds, effort.turn)
        for peer in ready:
            yield {"variable": variable, "value": value, "peer": peer, "updates_per_second": speed[peer]}


def operations(rows: int, dims: int) -> int:
    """Floating point operations of a point on a settled basis of n `rows`: 3 n² + 2 n (D + 2).

    φ = L⁻¹k costs n², A += ΦWΦᵀ costs 2 n², the distances 2 n D, novelty and b 2 n each; the exponentials of
    the kernel, n more, are not counted.
    """
    return 3 * rows**2 + 2 * rows * (dims + 2)


def measure_settled(effort: Effort) -> Iterator[Row]:
    """Speed on a full basis that admits no more, beside the machine's matrix product."""
    stream = novel(effort.points)
    for budget, block in effort.settled:
        peer = Sparse(stream, budget)
        feed = Feed(peer, stream)
        feed.until(2 * budget, effort.patience)
        feed.block = block
        peer.gp.novelty_threshold = NEVER
        speed = rates({"update": feed, "matrix product": matrix_product()}, effort.rounds, effort.turn)
        work = operations(int(peer.gp.size), stream.inputs.shape[-1]) * speed["update"]
        yield {
            "budget": budget,
            "block": block,
            "updates_per_second": speed["update"],
            "gflops": work / 1e9,
            "machine_gflops": speed["matrix product"] / 1e9,
            "fraction": work / speed["matrix product"],
        }


def measure_learners(effort: Effort) -> Iterator[Row]:
    """Points per second of L learners in one process with a leading dimension, and of L processes in turn."""
    stream = pendulum(effort.points)
    for block in (1, 8, 32):
        for learners in effort.learners:
            data = staggered(stream, learners)
            alone = [
                replace(data, inputs=x, targets=y) for x, y in zip(data.inputs, data.targets, strict=True)
            ]
            together = Feed(Sparse(data, LEARNER_BUDGET), data)
            apart = [Feed(Sparse(own, LEARNER_BUDGET), own) for own in alone]
            for feed in (together, *apart):
                feed.until(2 * LEARNER_BUDGET, effort.patience)
                feed.block = block
            turns = {"together": _times(learners, together), "apart": _in_turn(apart)}
            speed = rates(turns, effort.rounds, effort.turn)
            ratio = speed["together"] / speed["apart"]
            yield {"block": block, "learners": learners, **speed, "ratio": ratio}


def staggered(stream: Stream, learners: int) -> Stream:
    """The stream [learners, N, D], each learner starting at another place."""
    starts = [learner * len(stream.targets) // learners for learner in range(learners)]
    inputs = torch.stack([stream.inputs.roll(-start, 0) for start in starts])
    targets = torch.stack([stream.targets.roll(-start, 0) for start in starts])
    return replace(stream, inputs=inputs, targets=targets)


def _times(factor: int, turn: Callable[[], int]) -> Callable[[], int]:
    return lambda: factor * turn()


def _in_turn(feeds: Sequence[Feed]) -> Callable[[], int]:
    return lambda: sum(feed() for feed in feeds)


def measure_prediction(effort: Effort) -> Iterator[Row]:
    """Seconds to predict mean and variance at 1 and at 1,024 points, with a full basis."""
    stream = novel(effort.points)
    ready = prepared(stream, BUDGET, 2 * BUDGET, effort.patience)
    for count in (1, 1024):
        inputs = stream.inputs[:count]
        turns = {peer: _calls(feed.peer, inputs) for peer, feed in ready.items()}
        for peer, calls in rates(turns, effort.rounds, effort.turn).items():
            yield {"peer": peer, "points": count, "seconds": 1 / calls}


def _calls(peer: Peer, inputs: torch.Tensor) -> Callable[[], int]:
    def turn() -> int:
        peer.predict(inputs)
        return 1

    return turn


def measure(effort: Effort, console: Console) -> dict[str, object]:
    """Everything, as plain numbers for JSON."""
    sections: dict[str, tuple[Iterator[Row], int]] = {
        "streams": (compare_streams(effort), len(STREAMS) * len(PEERS)),
        "accuracy": (compare_accuracy(effort), 2 * len(STREAMS) * (len(PEERS) - 1)),
        "budget": (compare_over(effort, "budget", effort.budgets), len(effort.budgets) * len(PEERS)),
        "block": (compare_over(effort, "block", effort.blocks), len(effort.blocks) * len(PEERS)),
        "dims": (compare_over(effort, "dims", effort.dims), len(effort.dims) * len(PEERS)),
        "settled": (measure_settled(effort), len(effort.settled)),
        "learners": (measure_learners(effort), 3 * len(effort.learners)),
        "prediction": (measure_prediction(effort), 2 * len(PEERS)),
    }
    setting = {"budget": BUDGET, "block": BLOCK, "learner_budget": LEARNER_BUDGET}
    results: dict[str, object] = {"machine": machine(), "effort": asdict(effort), "setting": setting}
    columns = (TextColumn("{task.description:<12}"), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        for name, (rows, total) in sections.items():
            results[name] = list(progress.track(rows, total=total, description=name))
    return results


def main(options: Options, effort: Effort | None = None) -> None:
    """Measure, print, write."""
    effort = effort or (QUICK if options.quick else Effort())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            results = measure(effort, Console(stderr=True))
    finally:
        torch.set_num_threads(threads)
    gp_report.print_tables(results, Console())
    for path in gp_report.write(results, options.out):
        print(f"wrote {path}")


if __name__ == "__main__":
    main(tyro.cli(Options))
