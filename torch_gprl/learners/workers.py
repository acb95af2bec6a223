"""Experience from several processes: TorchRL's multi-process collectors, fed with policy and critic.

    with contextlib.closing(WorkerCollection(factories, learner.policy, steps, learner.critic)) as workers:
        learner.collection = workers
        for figures in learner.train(): ...

How policy and critic reach them is told in `board`, how their state comes back in `worker_state`.
"""

import contextlib
import copy
import functools
import signal
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.weight_update import NoWeightSyncScheme

from torch_gprl.learners.board import Board, FollowingPolicy
from torch_gprl.learners.collecting import watched
from torch_gprl.learners.worker_state import ResumableCollector, packed, streams_of, unpacked

LAST_BREATH = 2.0  # s between the moment when a worker's pipe breaks and its end


class WorkerCollection:
    """Rollouts [learners, envs, T] collected by several processes on one machine; see `Collection`.

    Synchronous workers share a rollout's environments, and all of it is made by the policy of the moment.
    Asynchronous ones make whole rollouts in turn while the learner learns: a rollout may have been begun
    under an older policy. Workers take up a new policy between two steps.

    Every worker has random numbers of its own, drawn from the policy's streams. Synchronous workers repeat
    themselves if their number stays, and save their simulations: a resumed run continues bit for bit, if it
    gets this collection before it loads its state. Asynchronous ones begin new episodes. Scripts that use
    workers need the guard `if __name__ == "__main__"`.

    Args:
        factories: one for each worker, makes its environment of batch [learners, envs of this worker].
        policy: reads `observation`, writes `action`.
        steps: T, steps of each environment in a rollout.
        critic: what the policy explores by, if it does.
        asynchronous: workers do not wait for the learner.

    Raises:
        ValueError: no factory.
    """

    def __init__(
        self,
        factories: Sequence[Callable[[], EnvBase]],
        policy: TensorDictModuleBase,
        steps: int,
        critic: nn.Module | None = None,
        asynchronous: bool = False,
    ) -> None:
        if not factories:
            raise ValueError("workers need environments: give one factory for each worker, got none")
        self.factories, self.steps, self.asynchronous = list(factories), steps, asynchronous
        modules = {"policy": policy} if critic is None else {"policy": policy, "critic": critic}
        self._followed = nn.ModuleDict(modules)
        self._copies = copied_for_workers(self._followed, len(self.factories))
        self._collector: MultiSyncCollector | MultiAsyncCollector | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None  # of the board, and of what failures say
        self._resumed: list[dict[str, Any]] = []  # what each worker goes on from

    def rollout(self) -> TensorDictBase:
        """The next T steps, after the workers have been told of today's policy.

        Raises:
            RuntimeError: a worker failed; the message tells why. The learner's state is unharmed.
        """
        with self._failures_told():
            if self._collector is None:
                self._start()
            self._board.post(self._followed)
            return next(self._rollouts)

    def _start(self) -> None:
        """Start the workers, from where they stood if there is something to resume."""
        self._folder = tempfile.TemporaryDirectory(prefix="torch-gprl-")
        folder = Path(self._folder.name)
        self._board = Board(folder / "board")
        self._board.post(self._followed)  # workers try the policy before the first rollout
        sample = self.factories[0]()
        frames = self.steps * sample.batch_size.numel()
        sample.close()
        kind: type[MultiSyncCollector | MultiAsyncCollector] = MultiAsyncCollector
        options: dict[str, Any] = {}
        if not self.asynchronous:
            kind, frames = MultiSyncCollector, frames * len(self._copies)
            options = {"cat_results": 1}  # environments side by side
        self._collector = kind(
            [functools.partial(made, factory) for factory in self.factories],
            policy_factory=[
                functools.partial(FollowingPolicy, part, folder / "board") for part in self._copies
            ],
            frames_per_batch=frames,
            total_frames=-1,
            weight_sync_schemes={"policy": NoWeightSyncScheme()},
            auto_register_policy_transforms=False,
            init_fn=_leave_interrupts_to_the_learner,
            collector_class=functools.partial(ReportingCollector, reports=folder),
            **options,
        )
        if self._resumed:
            workers = {f"worker{i}": packed(state) for i, state in enumerate(self._resumed)}
            self._collector.load_state_dict(OrderedDict(**workers, frames=0, iter=0))
            self._resumed = []
        self._rollouts = iter(self._collector)

    @contextlib.contextmanager
    def _failures_told(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # TorchRL may fail in ending the other workers
            cause = self._cause() or error
            self.close()
            raise RuntimeError(
                f"a worker failed: {cause}. What was learned until now is unharmed: "
                "save it, or go on from the last checkpoint"
            ) from error

    def _cause(self) -> str:
        """What failed workers have left word of, or how they ended."""
        reports = sorted(Path(self._folder.name).glob("worker-*.txt")) if self._folder else []
        if reports:
            return "; ".join(f"{path.stem}: {path.read_text(encoding='utf-8')}" for path in reports)
        processes = [] if self._collector is None else self._collector.procs
        with contextlib.suppress(ValueError):  # of closed processes
            wait([process.sentinel for process in processes], timeout=LAST_BREATH)
        codes = enumerate(map(_exit_code, processes))
        return "; ".join(f"worker-{i} ended with exit code {code}" for i, code in codes if code)

    def close(self) -> None:
        """End the workers."""
        if self._collector is not None:
            self._collector.shutdown(raise_on_error=False)
        if self._folder is not None:
            self._folder.cleanup()
        self._collector = self._folder = None

    def state_dict(self) -> dict[str, Any]:
        """Where synchronous workers stand: tensors and plain numbers; nothing once they have ended.

        Raises:
            RuntimeError: a worker failed; the message tells why.
        """
        if self.asynchronous:
            return {}
        if self._collector is None:
            return {"workers": self._resumed}
        with self._failures_told():
            state = self._collector.state_dict()
        return {"workers": [unpacked(state[f"worker{i}"]) for i in range(len(self.factories))]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` gave; from new episodes, if another collection did."""
        self.close()
        workers = state.get("workers", [])
        self._resumed = workers if len(workers) == len(self.factories) else []


class ReportingCollector(ResumableCollector):
    """A worker's collector, which leaves the cause in a file when it fails; TorchRL prints it at most."""

    def __init__(self, *args: Any, reports: Path, worker_idx: int | None = None, **options: Any) -> None:  # noqa: ANN401
        self.report = reports / f"worker-{worker_idx}.txt"
        super().__init__(*args, worker_idx=worker_idx, **options)

    def iterator(self) -> Any:  # noqa: ANN401  (TorchRL's iterator of rollouts)
        """TorchRL's rollouts."""
        try:
            yield from super().iterator()
        except Exception as error:
            self.report.write_text(f"{type(error).__name__}: {error}", encoding="utf-8")
            raise


def copied_for_workers(modules: nn.ModuleDict, count: int) -> list[nn.ModuleDict]:
    """Copies of policy and critic that see each other as the originals do, with noise of their own."""
    copies = [copy.deepcopy(modules) for _ in range(count)]
    for original, *parts in zip(modules.modules(), *(one.modules() for one in copies), strict=True):
        for name, stream in streams_of(original):
            for part, own in zip(parts, stream.split(count), strict=True):
                setattr(part, name, own)
    return copies


def _leave_interrupts_to_the_learner() -> None:
    """Ctrl-C reaches all processes of a terminal; the learner ends its workers in its own time."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _exit_code(process: BaseProcess) -> int | None:
    """How a process ended, unless it runs, or was ended by TorchRL because another one had failed."""
    try:
        return None if process.exitcode == -signal.SIGTERM else process.exitcode
    except ValueError:  # closed
        return None


def made(factory: Callable[[], EnvBase]) -> EnvBase:
    """A worker's environment, watched as `Collection` watches its own."""
    torch.set_num_threads(1)
    return watched(factory())
