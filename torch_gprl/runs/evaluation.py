"""What a policy is worth without exploration, and what it looks like."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, UInt8
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_gprl.runs.intervals import bootstrap_interval

SIDE = 320  # width and height of a film, pixels; the time to draw grows with its square


@runtime_checkable
class Picturesque(Protocol):
    """An environment of batch `[learners, num_envs]` that can be looked at."""

    def reset(self) -> TensorDictBase:
        """Start all episodes."""
        ...

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and start finished episodes anew."""
        ...

    def render(self, learner: int, env: int, width: int, height: int) -> UInt8[Tensor, "H W 3"]:
        """A picture of one copy."""
        ...


def evaluate(env: EnvBase, policy: TensorDictModuleBase) -> Float[Tensor, "learners num_envs"]:
    """Undiscounted return of the deterministic policy in the first episode of every environment.

    The starts are those of the environment's seed: a new environment of the same seed gives the same starts.

    Args:
        env: batch `[learners, num_envs]`; every episode must end.
        policy: writes `action`.
    """
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        running = torch.ones(env.batch_size, dtype=torch.bool, device=state.device)
        returns = torch.zeros(env.batch_size, dtype=torch.float64, device=state.device)
        while running.any():
            step, state = env.step_and_maybe_reset(policy(state))
            returns += step["next", "reward"].squeeze(-1).where(running, 0)
            running &= ~step["next", "done"].squeeze(-1)
    return returns


def summary(returns: Float[Tensor, "learners episodes"]) -> str:
    """The final result in one line; over learners, or over episodes if there is one learner.

    Args:
        returns: of every episode.
    """
    learners, episodes = returns.shape
    values = (returns.mean(dim=1) if learners > 1 else returns[0]).cpu().numpy()
    over = f"{learners} learners, {episodes} episodes each" if learners > 1 else f"{episodes} episodes"
    low, high = bootstrap_interval(values)
    return (
        f"final return {values.mean():.2f}, 95 % interval [{low:.2f}, {high:.2f}], "
        f"worst {values.min():.2f}, best {values.max():.2f}, over {over}"
    )


def film(
    env: Picturesque, policy: TensorDictModuleBase, learner: int, most_frames: int
) -> UInt8[Tensor, "T H W 3"]:
    """Pictures of one learner's deterministic policy, from the start of an episode to its end.

    Args:
        env: batch `[learners, num_envs]`; its first environment of the learner is shown.
        policy: writes `action`.
        learner: whom to show.
        most_frames: where to stop at the latest.
    """
    frames = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        for _ in range(most_frames):
            frames.append(env.render(learner=learner, env=0, width=SIDE, height=SIDE))
            step, state = env.step_and_maybe_reset(policy(state))
            if step["next", "done"][learner, 0].item():
                break
    return torch.stack(frames)
