"""What workers know of the learner: policy and critic in memory that all processes map.

TorchRL's weight sync carries a policy's own tensors. Here the critic travels too, since exploration may ask
it for its variance, and it arrives through `load_state_dict`, by which a Gaussian process learns that it has
changed. Two counters guard against torn reads: the learner raises the first, writes, then raises the second;
a worker that finds them different has read half of a change, and keeps what it has.
"""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

PLAIN = "plain numbers"  # their entry among the tensors


class Board:
    """Tensors of modules where other processes can read them, in files that all of them map into memory.

    Args:
        folder: of the files; made by the first `post`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._posted: TensorDict | None = None

    def post(self, modules: nn.Module) -> None:
        """Write all tensors and plain numbers of `modules`, between the two counters."""
        state = content_of(modules)
        if self._posted is None:
            counters = {"head": torch.zeros((), dtype=torch.long), "tail": torch.zeros((), dtype=torch.long)}
            content = TensorDict({**counters, "state": TensorDict({k: v.cpu() for k, v in state.items()})})
            self._posted = content.memmap(str(self.folder))
        posted = self._posted
        posted["head"].add_(1)
        for name, tensor in state.items():
            posted["state", name].copy_(tensor)
        posted["tail"].copy_(posted["head"])

    def read(self, seen: int) -> tuple[int, dict[str, Tensor]] | None:
        """Version and tensors, if there is a whole version other than `seen`."""
        if self._posted is None:
            self._posted = TensorDict.load_memmap(self.folder)
        version = int(self._posted["tail"])
        if version == seen:
            return None
        state = self._posted.get("state").clone().to_dict()
        return (version, state) if int(self._posted["head"]) == version else None


class FollowingPolicy(TensorDictModuleBase):
    """A worker's copy of the policy, which takes up what the learner has posted before it acts.

    Args:
        modules: copies of "policy" and, if it is followed, of "critic".
        folder: of the board.
    """

    def __init__(self, modules: nn.ModuleDict, folder: Path) -> None:
        super().__init__()
        policy = modules["policy"]
        assert isinstance(policy, TensorDictModuleBase)
        self.in_keys = list(policy.in_keys)  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = list(policy.out_keys)  # pyright: ignore[reportAttributeAccessIssue]
        self.modules_followed, self.policy = modules, policy
        self.board, self.version = Board(folder), 0

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act as the learner's policy would."""
        news = self.board.read(self.version)
        if news is not None:
            self.version, state = news
            take_up(self.modules_followed, state)
        return self.policy(tensordict)


def content_of(modules: nn.Module) -> dict[str, Tensor]:
    """All that actions may depend on: tensors, and plain public numbers such as annealed widths.

    What modules save beside tensors belongs to one process, such as the functions that its episodes act on.
    """
    numbers = [float(getattr(module, name)) for module, name in _plain(modules)]
    tensors = {name: value for name, value in modules.state_dict().items() if isinstance(value, Tensor)}
    return {**tensors, PLAIN: torch.tensor(numbers, dtype=torch.float64)}


def take_up(modules: nn.Module, content: dict[str, Tensor]) -> None:
    """Give copies of modules the content of the originals."""
    tensors = {name: tensor for name, tensor in content.items() if name != PLAIN}
    modules.load_state_dict({**modules.state_dict(), **tensors})
    for (module, name), number in zip(_plain(modules), content[PLAIN].tolist(), strict=True):
        kind = type(getattr(module, name))
        setattr(module, name, kind(number))


def _plain(modules: nn.Module) -> list[tuple[nn.Module, str]]:
    return [
        (module, name)
        for module in modules.modules()
        for name, value in vars(module).items()
        if isinstance(value, bool | int | float) and not name.startswith("_")
    ]
