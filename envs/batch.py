"""The environment for TorchRL: copies of a task as an `EnvBase` of batch [learners, num_envs].

Time limits set `truncated`, the task's rule sets `terminated`, and the two are never merged, so that values can
be bootstrapped at time limits.
"""

import mujoco
import torch
from jaxtyping import UInt8
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.copies import Copies, Options
from envs.rendering import Picture
from envs.task import Plane, Task


class BatchEnv(EnvBase):
    """A task's copies as one TorchRL environment of batch `[learners, num_envs]`.

    Keys: `observation` [..., do]; `action` [..., da] in the actuators' units, clipped to their bounds; under
    `next` also `reward`, `terminated`, `truncated`, `done` [..., 1], and with `Options.info` the reward's named
    parts under `info`. A copy whose simulation diverges ends with `terminated` in the last state it had.

    Args:
        task: the task.
        options: how many copies, where, and with which noise.

    Attributes:
        task: the task.
        plane: its picture plane, or None.
    """

    # TorchRL wraps an environment that has an attribute `frame_skip`; ours repeats physics steps itself.
    _has_frame_skip = True

    def __init__(self, task: Task, options: Options) -> None:
        shape = torch.Size([options.learners, options.num_envs])
        super().__init__(device=torch.device(options.device), batch_size=shape)
        self.task, self.options = task, options
        self.plane: Plane | None = task.plane
        self._copies = Copies(task, options)
        self._pictures: dict[tuple[int, int], Picture] = {}
        self._make_specs()

    @property
    def divergences(self) -> int:
        """How many simulations have diverged since the environment was built."""
        return self._copies.divergences

    def _make_specs(self) -> None:
        """Read the observation's size and the reward's parts off a trial state."""
        shape, dtype, device = self.batch_size, self.options.dtype, self.device
        copies = self._copies
        size = self.task.observation(copies.state).shape[-1]
        parts = self.task.reward(copies.state, copies.low.expand(copies.size, -1), copies.state).parts
        one = torch.Size([*shape, 1])
        observation = Unbounded(torch.Size([*shape, size]), dtype=dtype, device=device)
        self.observation_spec = Composite(observation=observation, shape=shape)
        self._parts = tuple(parts) if self.options.info else ()
        if self._parts:
            info = {name: Unbounded(one, dtype=dtype, device=device) for name in parts}
            self.observation_spec["info"] = Composite(info, shape=shape)
        low, high = (bound.to(device, dtype).expand(*shape, -1) for bound in (copies.low, copies.high))
        self.action_spec = Bounded(low, high, shape=low.shape, dtype=dtype, device=device)
        self.reward_spec = Unbounded(one, dtype=dtype, device=device)
        flags = {name: Binary(1, shape=one, dtype=torch.bool, device=device) for name in FLAGS}
        self.done_spec = Composite(flags, shape=shape)

    def _set_seed(self, seed: int | None) -> None:
        self._copies.seed(self.options.seed if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._copies.all if mask is None else mask.reshape(-1).cpu().numpy().nonzero()[0]
        self._copies.reset(rows)
        out = {"observation": self._out(self._copies.observation())}
        for name in FLAGS:
            out[name] = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        if self._parts:
            zero = torch.zeros(*self.batch_size, 1, dtype=self.options.dtype, device=self.device)
            out["info"] = TensorDict({name: zero.clone() for name in self._parts}, self.batch_size)
        return TensorDict(out, self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        observation, reward, parts, terminated, truncated = self._copies.step(self._command(tensordict))
        out = {
            "observation": self._out(observation),
            "reward": self._out(reward),
            "terminated": self._out(terminated),
            "truncated": self._out(truncated),
            "done": self._out(terminated | truncated),
        }
        if self._parts:
            out["info"] = TensorDict({name: self._out(parts[name]) for name in self._parts}, self.batch_size)
        return TensorDict(out, self.batch_size, device=self.device)

    def _command(self, tensordict: TensorDictBase) -> Tensor:
        """The action as [B, da] on the CPU.

        Raises:
            ValueError: if its shape is wrong or an entry is not finite.
        """
        action = tensordict.get("action")
        expected = self.action_spec.shape
        if action.shape != expected:
            raise ValueError(
                f"action must be [learners, num_envs, action size] = {list(expected)}, not {list(action.shape)}"
            )
        action = action.reshape(-1, expected[-1]).cpu()
        if not action.isfinite().all():
            copy, entry = (~action.isfinite()).nonzero()[0].tolist()
            learner, env = divmod(copy, expected[1])
            raise ValueError(
                f"actions must be finite, but learner {learner}, environment {env} got "
                f"action[{entry}] = {action[copy, entry].item()}; look for a diverged policy or an empty batch"
            )
        return action

    def _out(self, value: Tensor) -> Tensor:
        """[B] or [B, n] as `[learners, num_envs, 1 or n]` in the output's dtype and on its device."""
        dtype = torch.bool if value.dtype == torch.bool else self.options.dtype
        return value.reshape(*self.batch_size, -1).to(self.device, dtype)

    def render(
        self, learner: int = 0, env: int = 0, width: int = 480, height: int = 480
    ) -> UInt8[Tensor, "H W 3"]:
        """A picture of one environment's present state."""
        if (width, height) not in self._pictures:
            model = mujoco.MjModel.from_xml_path(str(self.task.scene))
            self._pictures[width, height] = Picture(model, self.task.pose, width, height)
        qpos = self._copies.state.qpos.reshape(*self.batch_size, -1)[learner, env].numpy()
        return torch.from_numpy(self._pictures[width, height].frame(qpos))


FLAGS = ("terminated", "truncated", "done")
