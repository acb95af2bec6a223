"""Several processes, one posterior: replicas that each saw a part equal one process that saw all."""

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from tensordict import TensorDict

from torch_gprl.critics import GPActionValue
from torch_gprl.gp import ParallelSparseGP, SparseOnlineGP, broadcast_state
from torch_gprl.kernels import SquaredExponential

F64 = torch.float64
WORLD = 2
OPTIONS: dict[str, Any] = {"budget": 20, "noise_variance": 0.02, "novelty_threshold": 0.5}


def _process(rank: int, store: Path, job: Callable, arguments: tuple, results: Path) -> None:
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=WORLD)
    dist.barrier()  # a job that needs nobody could end before the other process has connected
    try:
        torch.save(job(rank, *arguments), results / f"{rank}.pt")
    finally:
        dist.destroy_process_group()


def in_parallel(folder: Path, job: Callable, *arguments: Any) -> list[Any]:
    """What `job(rank, *arguments)` gives in each of the processes."""
    context = multiprocessing.get_context("fork")  # no second import of torch
    workers = [
        context.Process(target=_process, args=(rank, folder / "store", job, arguments, folder))
        for rank in range(WORLD)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0] * WORLD
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(WORLD)]


def data(blocks: int, points: int, *batch: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Blocks for all processes: [*batch, WORLD * points, 2] and targets."""
    inputs = [4 * torch.rand(*batch, WORLD * points, 2, dtype=F64) for _ in range(blocks)]
    return [(x, x.sum(-1).sin() + 0.1 * torch.randn(x.shape[:-1], dtype=F64)) for x in inputs]


def share(rank: int, tensor: torch.Tensor, dim: int) -> torch.Tensor:
    return tensor.chunk(WORLD, dim)[rank]


def absorb(rank: int, blocks: list, batch: tuple[int, ...], options: dict[str, Any]) -> dict:
    gp = ParallelSparseGP(SquaredExponential(2, batch_shape=batch), **OPTIONS | options)
    for stamp, (inputs, targets) in enumerate(blocks):
        gp.update(share(rank, inputs, -2), share(rank, targets, -1), stamp=stamp)
    return gp.state_dict()


def assert_same_state(found: dict, expected: dict) -> None:
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        # pruning adds differences of large numbers to the evidence
        tolerance = 1e-8 if name.endswith("evidence_constant") else 1e-10
        torch.testing.assert_close(found[name], tensor, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("options", [{}, {"projection": "dtc"}, {"overshoot": 1}], ids=str)
def test_two_processes_equal_one_that_saw_all(tmp_path: Path, options: dict[str, Any]):
    blocks = data(6, 40, 3)  # full, and pruned
    found = in_parallel(tmp_path, absorb, blocks, (3,), options)
    alone = SparseOnlineGP(SquaredExponential(2, batch_shape=(3,)), **OPTIONS | options)
    for stamp, (inputs, targets) in enumerate(blocks):
        alone.update(inputs, targets, stamp=stamp)
    assert (alone.observations > alone.capacity).all()
    for state in found:
        assert_same_state(state, alone.state_dict())


def test_single_points_count_too(tmp_path: Path):
    blocks = data(30, 1)
    found = in_parallel(tmp_path, absorb, blocks, (), {})
    alone = SparseOnlineGP(SquaredExponential(2), **OPTIONS)
    for stamp, (inputs, targets) in enumerate(blocks):
        alone.update(inputs, targets, stamp=stamp)
    for state in found:
        assert_same_state(state, alone.state_dict())


def absorb_masked(rank: int, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> dict:
    gp = ParallelSparseGP(SquaredExponential(2), **OPTIONS)
    gp.update(share(rank, inputs, -2), share(rank, targets, -1), mask=share(rank, mask, -1))
    return gp.state_dict()


def test_processes_may_bring_different_shares(tmp_path: Path):
    (inputs, targets), mask = data(1, 50)[0], torch.ones(WORLD * 50, dtype=torch.bool)
    mask[50:93] = False  # of the second process, all but seven
    found = in_parallel(tmp_path, absorb_masked, inputs.where(mask[:, None], torch.nan), targets, mask)
    alone = SparseOnlineGP(SquaredExponential(2), **OPTIONS)
    alone.update(inputs[mask], targets[mask])
    for state in found:
        assert_same_state(state, alone.state_dict())


def absorb_unequal(rank: int) -> str:
    gp = ParallelSparseGP(SquaredExponential(2), **OPTIONS)
    with pytest.raises(ValueError, match="as many points, got 5 to 6") as error:
        gp.update(torch.zeros(5 + rank, 2), torch.zeros(5 + rank))
    return str(error.value)


def test_unequal_numbers_of_points_are_refused_everywhere(tmp_path: Path):
    assert all("mask=" in message for message in in_parallel(tmp_path, absorb_unequal))


def absorb_nan(rank: int) -> str:
    gp = ParallelSparseGP(SquaredExponential(2), **OPTIONS)
    inputs = torch.zeros(5, 2)
    inputs[2] = torch.nan if rank == 1 else 0.0
    with pytest.raises(ValueError, match="finite" if rank == 1 else "another process") as error:
        gp.update(inputs, torch.zeros(5))
    assert int(gp.observations) == 0
    return str(error.value)


def test_what_one_process_refuses_none_learns(tmp_path: Path):
    assert "10" in in_parallel(tmp_path, absorb_nan)[1]


def critic_of(gp: SparseOnlineGP) -> GPActionValue:
    return GPActionValue(gp)


def rollout_of(inputs: torch.Tensor, targets: torch.Tensor) -> TensorDict:
    columns = {"observation": inputs[..., :1], "action": inputs[..., 1:], "value_target": targets[..., None]}
    return TensorDict(columns, targets.shape)


def teach(rank: int, inputs: torch.Tensor, targets: torch.Tensor) -> dict:
    critic = critic_of(ParallelSparseGP(SquaredExponential(2), **OPTIONS))
    rollout = rollout_of(share(rank, inputs, -2), share(rank, targets, -1))
    if rank == 0:
        critic.standardise(rollout["observation"], rollout["action"], rollout["value_target"])
    broadcast_state(critic)
    critic.update(rollout)
    return critic.state_dict()


def test_a_critic_learns_from_the_rollouts_of_all_processes(tmp_path: Path):
    inputs, targets = data(1, 60)[0]
    found = in_parallel(tmp_path, teach, inputs, targets)
    alone = critic_of(SparseOnlineGP(SquaredExponential(2), **OPTIONS))
    first = rollout_of(share(0, inputs, -2), share(0, targets, -1))
    alone.standardise(first["observation"], first["action"], first["value_target"])
    alone.update(rollout_of(inputs, targets))
    for state in found:
        assert_same_state(state, alone.state_dict())


def test_there_must_be_a_process_group():
    with pytest.raises(RuntimeError, match="init_process_group first"):
        ParallelSparseGP(SquaredExponential(2), 20)


def refuse_arrival(rank: int) -> str:
    with pytest.raises(ValueError, match="order must be 'novelty'") as error:
        ParallelSparseGP(SquaredExponential(2), 20, order="arrival")
    return str(error.value)


def test_there_is_no_order_of_arrival(tmp_path: Path):
    assert len(in_parallel(tmp_path, refuse_arrival)) == WORLD
