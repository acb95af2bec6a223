"""What data-parallel updates cost and save: throughput, bytes and share of the exchange, by budget.

    python -m benchmarks.parallel_updates [--processes 2] [--out benchmarks/results/parallel_updates.json]

Every process absorbs blocks of its own from a settled stream. Time goes into weighing the points, which the
processes share out, and into the all-reduce, which they do not.
"""

import json
import multiprocessing
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import torch.distributed as dist
import tyro
from torch import Tensor

from benchmarks.timing import machine
from torch_gprl.gp import ParallelSparseGP, SparseOnlineGP
from torch_gprl.kernels import SquaredExponential

DIMS = 4
NOISE = 0.05


@dataclass(frozen=True)
class Options:
    """What to measure."""

    processes: int = 2  # that share out the points
    budgets: tuple[int, ...] = (50, 200, 800)  # basis vectors
    points: int = 2000  # of each process in each update: a rollout of ten environments
    seconds: float = 3.0  # of updates, for each figure
    out: Path | None = None  # JSON file


@dataclass(frozen=True)
class Cost:
    """Of one process, in updates of `points` each."""

    updates_per_second: float  # by the clock
    cpu_ms: float  # of processor time for each update, which a busy machine does not stretch
    exchange_share: float  # of the time, in the all-reduce of a message of this size
    basis: int  # vectors in use
    bytes: int  # of the all-reduce, for each update and learner


def stream(seed: int, points: int) -> tuple[Tensor, Tensor]:
    """Inputs [points, DIMS] and targets of a smooth function."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 3 * torch.rand(points, DIMS, dtype=torch.float64, generator=generator)
    noise = torch.randn(points, dtype=torch.float64, generator=generator)
    return inputs, inputs.sum(-1).sin() + NOISE**0.5 * noise


def measure(rank: int, options: Options, budget: int) -> Cost:
    """Updates of a full basis, and an all-reduce of the same size alone."""
    alone = options.processes == 1
    kind = SparseOnlineGP if alone else ParallelSparseGP
    gp = kind(SquaredExponential(DIMS), budget, NOISE)
    for block in range(2 + budget // options.points):
        gp.update(*stream(block * options.processes + rank, options.points))
    blocks = [stream(1000 + 10 * rank + block, options.points) for block in range(10)]
    # what has been learned so often is not novel: from here on the basis stays
    gp.novelty_threshold = 1e9
    seconds, updates, busy = 0.0, 0, time.process_time()
    while seconds < options.seconds:  # every process takes the same decision: rank 0's clock counts
        begin = time.perf_counter()
        for block in blocks:
            gp.update(*block)
        seconds += time.perf_counter() - begin
        updates += len(blocks)
        if not alone:
            clock = torch.tensor(seconds)
            dist.broadcast(clock, 0)
            seconds = float(clock)
    cpu_ms = 1000 * (time.process_time() - busy) / updates
    rows = int(gp.size)
    message = torch.zeros(rows * (rows + 1) // 2 + rows + 2, dtype=torch.float64)
    share = exchange(message) * updates / seconds
    return Cost(updates / seconds, cpu_ms, share, rows, 0 if alone else message.nbytes)


def exchange(message: Tensor, repeats: int = 50) -> float:
    """Seconds of one all-reduce; 0 without other processes."""
    if not dist.is_initialized():
        return 0.0
    begin = time.perf_counter()
    for _ in range(repeats):
        dist.all_reduce(message)
    return (time.perf_counter() - begin) / repeats


def process(rank: int, options: Options, budget: int, folder: Path) -> None:
    """One of the processes; leaves its cost in a file."""
    torch.set_num_threads(1)
    if options.processes > 1:
        store = f"file://{folder / 'store'}"
        dist.init_process_group("gloo", init_method=store, rank=rank, world_size=options.processes)
    cost = measure(rank, options, budget)
    if dist.is_initialized():
        dist.destroy_process_group()
    (folder / f"{rank}.json").write_text(json.dumps(asdict(cost)), encoding="utf-8")


def run(options: Options, budget: int) -> Cost:
    """The cost that process 0 has seen."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ranks = range(options.processes)
        workers = [context.Process(target=process, args=(rank, options, budget, folder)) for rank in ranks]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        return Cost(**json.loads((folder / "0.json").read_text(encoding="utf-8")))


def main(options: Options) -> None:
    """Measure one process and several, and print what they reach together."""
    rows = []
    for budget in options.budgets:
        single = run(Options(1, points=options.points, seconds=options.seconds), budget)
        shared = run(options, budget)
        speedup = options.processes * shared.updates_per_second / single.updates_per_second
        bound = options.processes * single.cpu_ms / shared.cpu_ms  # if every process had a core of its own
        found = {"speedup": speedup, "speedup_bound": bound}
        rows.append({"budget": budget, "alone": asdict(single), "shared": asdict(shared), **found})
        print(
            f"{single.basis} vectors: {options.points} points take {single.cpu_ms:.2f} ms of a processor, "
            f"{shared.cpu_ms:.2f} with {options.processes} processes that exchange {shared.bytes:,} bytes; "
            f"speed {speedup:.2f} times that of one, at most {bound:.2f}"
        )
    if options.out:
        found = machine() | {"points": options.points, "processes": options.processes, "results": rows}
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Options))
