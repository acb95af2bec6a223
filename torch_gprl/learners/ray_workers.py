"""Experience from several machines: TorchRL's Ray collector, fed with policy and critic.

Needs the extra `ray`. Connect to a cluster by `ray.init(address="auto")` before; without, Ray starts on this
machine. TorchRL carries the tensors; `CarriedPolicy` then lets a Gaussian process know that it has changed.
"""

import contextlib
import functools
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torch_gprl.learners.board import PLAIN, content_of, take_up
from torch_gprl.learners.worker_state import ResumableCollector, packed, streams_of, unpacked
from torch_gprl.learners.workers import made

ENDLESS = 2**62  # frames: TorchRL's own default stops Ray's collector at once


class RayCollection:
    """Rollouts [learners, envs, T] whose environments Ray's workers share out; see `Collection`.

    Synchronous: all of a rollout is made by the policy of the moment. A resumed run continues bit for bit, if
    it gets this collection before it loads its state.

    Args:
        factories: one for each worker, makes its environment of batch [learners, envs of this worker].
        policy: reads `observation`, writes `action`.
        steps: T, steps of each environment in a rollout.
        critic: what the policy explores by, if it does.
        cpus: processor cores that Ray sets aside for each worker; may be a fraction.
        ray_options: of `ray.init`, where that has not been called.

    Raises:
        ValueError: no factory.
        ModuleNotFoundError: Ray is not installed.
    """

    def __init__(
        self,
        factories: Sequence[Callable[[], EnvBase]],
        policy: TensorDictModuleBase,
        steps: int,
        critic: nn.Module | None = None,
        cpus: float = 1.0,
        ray_options: dict[str, Any] | None = None,
    ) -> None:
        if not factories:
            raise ValueError("workers need environments: give one factory for each worker, got none")
        if importlib.util.find_spec("ray") is None:
            raise ModuleNotFoundError(
                "collecting by Ray needs the package ray: pip install 'torch-gprl[ray]', or let "
                "WorkerCollection collect on this machine"
            )
        self.factories, self.steps = list(factories), steps
        self.cpus, self.ray_options = cpus, ray_options
        modules = {"policy": policy} if critic is None else {"policy": policy, "critic": critic}
        self._carried = CarriedPolicy(nn.ModuleDict(modules))
        self._collector: Any = None
        self._resumed: list[dict[str, Any]] = []  # what each worker goes on from

    def rollout(self) -> TensorDictBase:
        """The next T steps, after the workers have been told of today's policy.

        Raises:
            RuntimeError: a worker failed; the message tells why. The learner's state is unharmed.
        """
        self._carried.mark()
        with self._failures_told():
            if self._collector is None:
                self._collector = self._started()
            self._collector.update_policy_weights_()
            rollout = next(self._rollouts)
        return rollout.movedim(0, 1).flatten(1, 2)  # environments side by side

    def _started(self) -> Any:  # noqa: ANN401  (TorchRL's collector; importing it imports ray)
        from torchrl.collectors.distributed import RayCollector

        sample, workers = self.factories[0](), len(self.factories)
        frames = self.steps * sample.batch_size.numel() * workers
        sample.close()
        collector = RayCollector(
            [functools.partial(made, factory) for factory in self.factories],
            self._carried,
            frames_per_batch=frames,
            total_frames=ENDLESS,
            sync=True,
            collector_class=RayWorker,  # pyright: ignore[reportArgumentType]
            collector_kwargs=[
                {"worker": worker, "auto_register_policy_transforms": False} for worker in range(workers)
            ],
            remote_configs={"num_cpus": self.cpus, "num_gpus": 0},
            ray_init_config=self.ray_options,
        )
        if self._resumed:
            collector.load_state_dict([packed(state) for state in self._resumed])
            self._resumed = []
        self._rollouts = iter(collector)
        return collector

    @contextlib.contextmanager
    def _failures_told(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.close()
            raise RuntimeError(
                f"a worker failed: {error}. What was learned until now is unharmed: save it, or go on from "
                "the last checkpoint"
            ) from error

    def close(self) -> None:
        """End the workers."""
        if self._collector is not None:
            self._collector.shutdown()
        self._collector = None

    def state_dict(self) -> dict[str, Any]:
        """Where the workers stand: tensors and plain numbers; nothing once they have ended.

        Raises:
            RuntimeError: a worker failed; the message tells why.
        """
        if self._collector is None:
            return {"workers": self._resumed}
        with self._failures_told():
            return {"workers": [unpacked(state) for state in self._collector.state_dict()]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` gave; from new episodes, if another collection did."""
        self.close()
        workers = state.get("workers", [])
        self._resumed = workers if len(workers) == len(self.factories) else []


class CarriedPolicy(TensorDictModuleBase):
    """The policy with all that it acts by, as one module whose tensors TorchRL carries to its copies.

    Args:
        modules: "policy" and, if it travels, "critic".
    """

    numbers: Tensor
    version: Tensor

    def __init__(self, modules: nn.ModuleDict) -> None:
        super().__init__()
        policy = modules["policy"]
        assert isinstance(policy, TensorDictModuleBase)
        self.in_keys = list(policy.in_keys)  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = list(policy.out_keys)  # pyright: ignore[reportAttributeAccessIssue]
        self.carried = modules
        self.register_buffer("numbers", content_of(modules)[PLAIN])
        self.register_buffer("version", torch.zeros((), dtype=torch.long))
        self.seen = 0

    def mark(self) -> None:
        """Make the present state of the modules a new version."""
        self.numbers.copy_(content_of(self.carried)[PLAIN])
        self.version.add_(1)

    def begin(self, worker: int) -> None:
        """Draw random numbers that no other worker draws."""
        for module in self.carried.modules():
            for name, stream in streams_of(module):
                setattr(module, name, stream.split(worker + 1)[worker])

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act; a version that has just arrived is first taken up as a whole."""
        if int(self.version) != self.seen:
            self.seen = int(self.version)
            content = {name: tensor.clone() for name, tensor in content_of(self.carried).items()}
            take_up(self.carried, content | {PLAIN: self.numbers})
        policy = self.carried["policy"]
        return policy(tensordict)


class RayWorker(ResumableCollector):
    """A worker's collector, with random numbers of its own."""

    def __init__(
        self,
        create_env_fn: Callable[[], EnvBase],
        policy: CarriedPolicy,
        *,
        worker: int,
        **options: Any,  # noqa: ANN401
    ) -> None:
        policy.begin(worker)
        super().__init__(create_env_fn, policy, **options)  # pyright: ignore[reportArgumentType]
