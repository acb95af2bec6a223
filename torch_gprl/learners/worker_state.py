"""What a worker alone knows: its simulations, its random numbers, and the functions that its episodes act on.

TorchRL's collectors carry the states of their workers to the learner and back, for its checkpoints, but those
of environments and of random numbers are not among them.
"""

import io
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor, nn
from torchrl.collectors import Collector

from torch_gprl.learners.collecting import restore, state_of
from torch_gprl.policies.streams import NoiseStream


class ResumableCollector(Collector):
    """A worker's collector, whose state holds all that its next step depends on."""

    def state_dict(self) -> OrderedDict[str, Any]:
        """The state as bytes, as TorchRL would make a tensordict of it, which has no lists."""
        policy, streams = self._acting()
        own = {"policy": policy.state_dict(), "streams": [stream.state() for stream in streams]}
        return packed({**state_of(self), **own})

    def load_state_dict(self, state_dict: Mapping[str, Any], **options: Any) -> None:  # noqa: ANN401
        """Go on from what `state_dict` gave, by the policy that the learner gives next."""
        state = unpacked(state_dict)
        restore(self, state)
        policy, streams = self._acting()
        policy.load_state_dict(state["policy"])
        for stream, saved in zip(streams, state["streams"], strict=True):
            stream.restore(saved)

    def _acting(self) -> tuple[nn.Module, list[NoiseStream]]:
        """The policy, and its streams of random numbers."""
        assert isinstance(self.policy, nn.Module)
        return self.policy, [stream for module in self.policy.modules() for _, stream in streams_of(module)]


def streams_of(module: nn.Module) -> list[tuple[str, NoiseStream]]:
    """The streams of random numbers that a module itself holds, by name."""
    return [(name, value) for name, value in vars(module).items() if isinstance(value, NoiseStream)]


def packed(state: dict[str, Any]) -> OrderedDict[str, UInt8[Tensor, " bytes"]]:
    """A state of tensors and plain numbers as one tensor."""
    file = io.BytesIO()
    torch.save(state, file)
    return OrderedDict(packed=torch.from_numpy(np.frombuffer(file.getvalue(), dtype=np.uint8).copy()))


def unpacked(state: Mapping[str, Any]) -> dict[str, Any]:
    """What `packed` was given."""
    return torch.load(io.BytesIO(state["packed"].numpy().tobytes()), weights_only=True)
