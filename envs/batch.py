"""The environment for TorchRL: copies of a task as an `EnvBase` of batch [learners, num_envs].

Time limits set `truncated`, the task's rule sets `terminated`, and the two are never merged, so that values
can be bootstrapped at time limits.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.copies import Copies, Options
from envs.rendering import Pictures
from envs.task import Plane, Task

FLAGS = ("terminated", "truncated", "done")


class BatchEnv(EnvBase):
    """A task's copies as one TorchRL environment of batch `[learners, num_envs]`.

    Keys: `observation` [..., do]; `action` [..., da] in the actuators' units, clipped to their bounds; under
    `next` also `reward`, `terminated`, `truncated`, `done` [..., 1], and with `Options.info` the reward's
    named parts under `info`. A copy whose simulation diverges ends with `terminated` in the last good state.

    Args:
        task: the task.
        options: how many copies, where, and with which noise.

    Attributes:
        task: the task.
        options: as given.
        plane: the task's picture plane, or None.
    """

    def __init__(self, task: Task, options: Options) -> None:
        self._shape = torch.Size([options.learners, options.num_envs])
        super().__init__(device=torch.device(options.device), batch_size=self._shape)
        self.task, self.options = task, options
        self._place_outputs()
        self.plane: Plane | None = task.plane
        self._copies = Copies(task, options)
        self._pictures = Pictures(task)
        self._make_specs()

    @property
    def divergences(self) -> int:
        """How many simulations have diverged since the environment was built."""
        return self._copies.divergences

    @property
    def qpos(self) -> Float[Tensor, "learners num_envs nq"]:
        """The generalised positions, m or rad: a copy, float64, on the CPU."""
        return torch.from_numpy(self._copies.state.qpos.copy()).view(*self._shape, -1)

    @property
    def qvel(self) -> Float[Tensor, "learners num_envs nv"]:
        """The generalised velocities, m/s or rad/s: a copy, float64, on the CPU."""
        return torch.from_numpy(self._copies.state.qvel.copy()).view(*self._shape, -1)

    def place(
        self, qpos: Float[Tensor, "learners num_envs nq"], qvel: Float[Tensor, "learners num_envs nv"]
    ) -> TensorDict:
        """Start new episodes in the given states; returns what `reset` would."""
        self._copies.place(qpos.flatten(0, 1).numpy(force=True), qvel.flatten(0, 1).numpy(force=True))
        return self._started()

    def get_extra_state(self) -> dict[str, Tensor]:
        """The simulations, for `state_dict`: a run that loads it goes on bit for bit."""
        return self._copies.save()

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Take up what `get_extra_state` gave, for `load_state_dict`."""
        self._copies.load(state)

    def to(self, device: torch.device | str | int) -> "BatchEnv":
        """Give outputs on another device; the simulation stays where it is."""
        super().to(device)
        self._place_outputs()
        return self

    def _place_outputs(self) -> None:
        self._to = (self.device, self.options.dtype)
        self._on_host = self._to[0].type == "cpu"  # a cast to where a tensor already is costs microseconds
        self._kind = torch.empty(0, dtype=self._to[1]).numpy().dtype

    def _make_specs(self) -> None:
        """Read the observation's size and the reward's parts off a trial state."""
        shape, copies = self._shape, self._copies
        kind = {"device": self._to[0], "dtype": self._to[1]}
        size = self.task.observation(copies.state).shape[-1]
        parts = self.task.reward(
            copies.state, np.broadcast_to(copies.low, (copies.size, len(copies.low))), copies.state
        ).parts
        one = torch.Size([*shape, 1])
        self._parts = tuple(parts) if self.options.info else ()
        # Of outputs, by their number of dimensions in `Copies`.
        self._shapes = {1: one, 2: torch.Size([*shape, size])}
        self.observation_spec = Composite(observation=Unbounded(self._shapes[2], **kind), shape=shape)
        if self._parts:
            info = {name: Unbounded(one, **kind) for name in parts}
            self.observation_spec["info"] = Composite(info, shape=shape)
        low, high = (torch.tensor(bound, **kind).expand(*shape, -1) for bound in (copies.low, copies.high))
        self._action_shape = low.shape
        self.action_spec = Bounded(low, high, shape=low.shape, **kind)
        self.reward_spec = Unbounded(one, **kind)
        flags = {name: Binary(1, shape=one, dtype=torch.bool, device=self._to[0]) for name in FLAGS}
        self.done_spec = Composite(flags, shape=shape)

    def _set_seed(self, seed: int | None) -> None:
        self._copies.seed(self.options.seed if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._copies.all if mask is None else mask.reshape(-1).cpu().numpy().nonzero()[0]
        self._copies.reset(rows)
        return self._started()

    def _started(self) -> TensorDict:
        """What an agent sees of the present state when nothing is done."""
        device, dtype = self._to
        out: dict[str, Tensor | TensorDict] = {"observation": self._out(self._copies.observation())}
        for name in FLAGS:
            out[name] = torch.zeros(self._shapes[1], dtype=torch.bool, device=device)
        if self._parts:
            zeros = {name: torch.zeros(self._shapes[1], dtype=dtype, device=device) for name in self._parts}
            out["info"] = TensorDict(zeros, self._shape)
        return TensorDict(out, self._shape, device=device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        # The checks of the public constructor would cost a tenth of a step of 64 small simulations.
        return TensorDict._new_unsafe(self._outcome(tensordict)[0], self._shape, device=self._to[0])

    def _outcome(self, tensordict: TensorDictBase) -> tuple[dict[str, Tensor | TensorDictBase], bool]:
        """What a step under the given action leads to, and whether it ends any episode."""
        observation, reward, parts, terminated, truncated = self._copies.step(self._command(tensordict))
        done = terminated | truncated
        out: dict[str, Tensor | TensorDictBase] = {
            "observation": self._out(observation),
            "reward": self._out(reward),
            "terminated": self._tensor(terminated),
            "truncated": self._tensor(truncated),
            "done": self._tensor(done),
        }
        if self._parts:
            out["info"] = TensorDict({name: self._out(parts[name]) for name in self._parts}, self._shape)
        return out, bool(done.any())  # asked here: after a step, torch's first operation is the dear one

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """A step, then a reset of what is done; as TorchRL's, without the cases that we do not have."""
        keys = tensordict.keys()
        foreign = tensordict.batch_size != self._shape or tensordict.device != self._to[0]
        if foreign or "next" in keys or "_step" in keys:
            return super().step_and_maybe_reset(tensordict)
        (outcome, ended), device = self._outcome(tensordict), self._to[0]
        # The next step begins with all that this one had, and all that came after it but the reward.
        entries = dict(tensordict.items()) | outcome
        for key, value in entries.items():
            if type(value) is not Tensor and isinstance(value, TensorDictBase):
                entries[key] = value.copy()
        del entries["reward"]
        entries.pop("_reset", None)
        step = TensorDict._new_unsafe(outcome, self._shape, device=device)
        tensordict._set_str("next", step, validated=True, inplace=False, non_blocking=False)
        following = TensorDict._new_unsafe(entries, self._shape, device=device)
        return tensordict, self.maybe_reset(following) if ended else following

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Nothing: TorchRL completes and reshapes entries here, and `_step` leaves none to mend."""
        return next_tensordict_out

    def _command(self, tensordict: TensorDictBase) -> Float[np.ndarray, "B da"]:
        """The action for `Copies`.

        Raises:
            ValueError: if its shape is wrong or an entry is not finite.
        """
        action = tensordict.get("action")
        if action.shape != self._action_shape:
            raise ValueError(
                f"action must be [learners, num_envs, action size] = {list(self._action_shape)}, "
                f"not {list(action.shape)}"
            )
        flat = action.numpy(force=True).reshape(self._copies.size, -1)
        if math.isfinite(flat.sum()):  # the quick proof that all entries are
            return flat
        bad = (~action.isfinite()).nonzero().tolist()
        if bad:
            learner, env, entry = bad[0]
            raise ValueError(
                f"actions must be finite, but entry {entry} of learner {learner}, environment {env} is "
                f"{action[tuple(bad[0])].item()}; look for a diverged policy"
            )
        return flat

    def _out(self, value: NDArray[np.floating]) -> Tensor:
        """Numbers [B] or [B, n] as `[learners, num_envs, 1 or n]` in the output's dtype, on its device."""
        return self._tensor(value.astype(self._kind, copy=False))

    def _tensor(self, value: NDArray[Any]) -> Tensor:
        """Numbers or flags [B] or [B, n] as `[learners, num_envs, 1 or n]` on the output's device."""
        tensor = torch.from_numpy(value.reshape(self._shapes[value.ndim]))
        return tensor if self._on_host else tensor.to(self._to[0])

    def render(
        self, learner: int = 0, env: int = 0, width: int = 480, height: int = 480
    ) -> UInt8[Tensor, "H W 3"]:
        """A picture of one environment's present state."""
        return torch.from_numpy(self._pictures.frame(self.qpos[learner, env].numpy(), width, height))

    def render_all(self, width: int = 160, height: int = 160) -> UInt8[Tensor, "learners num_envs H W 3"]:
        """Pictures of all environments, for TorchRL's video recorder.

        Use `PixelRenderTransform(render_method="render_all")` before `VideoRecorder`, which tiles them.
        """
        frames = [self.render(learner, env, width, height) for learner, env in np.ndindex(self._shape)]
        return torch.stack(frames).unflatten(0, self._shape)
