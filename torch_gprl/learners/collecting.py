"""Experience for learners: rollouts that go on where the last one ended, in another process too.

TorchRL's `Collector` carries the environment's present state from rollout to rollout, but does not save it.
`Collection` does, together with the simulation, so that a resumed run continues bit for bit; collections by
several processes do so by the same two functions.
"""

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, Transform, TransformedEnv


class Collection:
    """Rollouts [learners, envs, T] of a policy, without end, with `episode_reward` and `step_count`.

    The environment is reset when the first rollout is asked for, and after that only where episodes end. A
    continuation is exact if the environment saves its simulation in `state_dict`, as those of this project
    do; others begin new episodes when a state is loaded.

    Args:
        env: environment of batch [learners, envs].
        policy: reads `observation`, writes `action`.
        steps: T, steps of each environment in a rollout.
    """

    def __init__(self, env: EnvBase, policy: TensorDictModuleBase, steps: int) -> None:
        self.env, self.policy, self.steps = env, policy, steps
        self._collector: Collector | None = None

    def rollout(self) -> TensorDictBase:
        """The next T steps.

        Raises:
            FloatingPointError: if an observation or a reward is not finite.
        """
        if self._collector is None:
            self._start()
        return next(self._rollouts)

    def _start(self) -> Collector:
        """Reset the environment, and try the policy once, as TorchRL does to learn its keys."""
        self._collector = Collector(
            watched(self.env),
            self.policy,
            frames_per_batch=self.steps * self.env.batch_size.numel(),
            total_frames=-1,
            auto_register_policy_transforms=False,
            track_traj_ids=False,
        )
        self._rollouts = iter(self._collector)
        return self._collector

    def state_dict(self) -> dict[str, Any]:
        """The simulation and what it carries into the next step: tensors and plain numbers."""
        return {} if self._collector is None else state_of(self._collector)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave; tries the policy, so restore its random numbers after this.

        The state of a collection by several processes begins new episodes here.
        """
        self._collector = None
        if state.get("simulation"):
            restore(self._start(), state)

    def close(self) -> None:
        """Nothing: all is in this process."""


def state_of(collector: Collector) -> dict[str, Any]:
    """A collector's simulation, and what it carries into the next step: tensors and plain numbers."""
    return {
        "simulation": _simulation(collector.env).state_dict(),
        "transforms": collector.env.state_dict(),
        # TorchRL has no public name for the observations and counters before the next step.
        "carried": collector._carrier.to_dict(),
    }


def restore(collector: Collector, state: dict[str, Any]) -> None:
    """Let a collector go on from what `state_of` gave, unless its simulation saves nothing."""
    if not state["simulation"]:
        return
    simulation = _simulation(collector.env)
    simulation.load_state_dict(state["simulation"])
    collector.env.load_state_dict(state["transforms"])
    collector._carrier.update(TensorDict(state["carried"], simulation.batch_size).to(simulation.device))


def _simulation(env: EnvBase) -> EnvBase:
    """What is below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def watched(env: EnvBase) -> TransformedEnv:
    """The environment with what learners read beside it, and with a check of all that it gives."""
    transforms = Compose(FiniteExperience(), RewardSum(), StepCounter())  # pyright: ignore[reportCallIssue]
    return TransformedEnv(env, transforms, auto_unwrap=True)


class FiniteExperience(Transform):
    """Refuses observations and rewards that are not finite, before a policy or a critic learns them."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        _refuse_non_finite(tensordict_reset, "observation")
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        _refuse_non_finite(next_tensordict, "observation")
        _refuse_non_finite(next_tensordict, "reward")
        return next_tensordict


def _refuse_non_finite(tensordict: TensorDictBase, key: str) -> None:
    value: Tensor = tensordict.get(key)
    if math.isfinite(value.sum().item()):  # the quick proof that all entries are
        return
    bad = (~value.isfinite()).nonzero().tolist()
    if bad:
        learner, env, entry = bad[0]
        raise FloatingPointError(
            f"the environment gave a {key} that is not finite: entry {entry} of learner {learner}, "
            f"environment {env} is {value[tuple(bad[0])].item()}; "
            "look for a diverged simulation or a faulty reward"
        )


def batch_of(env: EnvBase) -> tuple[int, int]:
    """Learners and environments of each, the batch of a learner's environment.

    Raises:
        ValueError: the batch is another.
    """
    if len(env.batch_size) != 2:
        raise ValueError(
            f"the environment's batch must be [learners, environments], got {tuple(env.batch_size)}"
        )
    learners, num_envs = env.batch_size
    return learners, num_envs


def mean_return(rollout: TensorDictBase, last: Tensor) -> Tensor:
    """Mean return of the episodes that ended in a rollout [learners]; the `last` one known where none did."""
    ended = rollout.get(("next", "done")).squeeze(-1).flatten(1)
    returns = rollout.get(("next", "episode_reward")).squeeze(-1).flatten(1)
    return torch.where(ended.any(1), (returns * ended).sum(1) / ended.sum(1), last)
