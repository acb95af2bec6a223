"""Does a critic foresee what happens? Its predictions along episodes, against the returns that came."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_gprl.runs.figures import COLOUR, open_frame

LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])
POINTS_AT_ONCE = 500  # states that the critic judges together, for each learner: bounds the memory


@dataclass(frozen=True)
class Foresight:
    """What a critic predicted and what came, over the states of some episodes.

    Attributes:
        mean, stddev: posterior of V(s) = Q(s, f(s)), in units of the return.
        realised: discounted return from the state on; where time ran out, the critic's value ends the sum.
    """

    mean: Float[np.ndarray, " states"]
    stddev: Float[np.ndarray, " states"]
    realised: Float[np.ndarray, " states"]

    def coverage(self) -> Float[np.ndarray, " levels"]:
        """Share of the returns inside the central interval of each of `LEVELS`."""
        score = torch.from_numpy(np.abs(self.realised - self.mean) / self.stddev)
        inside = torch.erf(score / 2**0.5)  # probability of the smallest interval that holds the return
        return (inside[None] <= torch.from_numpy(LEVELS)[:, None]).double().mean(1).numpy()


@torch.no_grad()
def foresee(
    env: EnvBase,
    policy: TensorDictModuleBase,
    critic: Any,  # noqa: ANN401  (this floor knows no Gaussian process)
    discount: float,
    learner: int,
) -> Foresight:
    """Follow the deterministic policy through one episode in every environment.

    Args:
        env: batch `[learners, num_envs]`; every episode must end.
        policy: writes `action`.
        critic: has `value(observation, action)` with a mean and a variance.
        discount: γ per step.
        learner: whose critic and policy.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        running = torch.ones(env.batch_size, dtype=torch.bool, device=state.device)
        seen, alive = [], []
        while running.any():
            step, state = env.step_and_maybe_reset(policy(state))
            seen.append(step.select("observation", "action", "next").clone())
            alive.append(running.clone())
            running &= ~step["next", "done"].squeeze(-1)
        past = TensorDict.maybe_dense_stack(seen, -1)  # [learners, num_envs, T]
        reached = past.get(("next", "observation"))
        ahead = TensorDict({"observation": reached.flatten(1, 2)}, (len(reached), reached[0, ..., 0].numel()))
        acted = policy(ahead).get("action").unflatten(1, reached.shape[1:3])
        mean, variance = _values(critic, past.get("observation"), past.get("action"), learner)
        beyond, _ = _values(critic, reached, acted, learner)
    reward, done, terminated = (
        past.get(("next", name))[learner].squeeze(-1) for name in ("reward", "done", "terminated")
    )
    realised = _returns(reward.double(), torch.where(terminated, 0, beyond), done, discount)
    kept = torch.stack(alive, -1)[learner]
    chosen = (mean[kept], variance[kept].sqrt(), realised[kept])
    return Foresight(*(value.double().cpu().numpy() for value in chosen))


def _values(critic: Any, observation: Tensor, action: Tensor, learner: int) -> tuple[Tensor, Tensor]:  # noqa: ANN401
    """Mean and variance of one learner's values at points [learners, num_envs, T, ...]."""
    points = zip(
        observation.flatten(1, 2).split(POINTS_AT_ONCE, 1),
        action.flatten(1, 2).split(POINTS_AT_ONCE, 1),
        strict=True,
    )
    values = [critic.value(*some) for some in points]
    shape = observation.shape[1:3]
    mean = torch.cat([value.mean[learner] for value in values]).unflatten(0, shape)
    return mean, torch.cat([value.variance[learner] for value in values]).unflatten(0, shape)


def _returns(reward: Tensor, beyond: Tensor, done: Tensor, discount: float) -> Tensor:
    """Discounted returns [num_envs, T]: G_t = r_t + γ (V(s_{t+1}) where step t is the last, else G_{t+1})."""
    returns = torch.zeros_like(reward)
    following = beyond[:, -1]
    for t in reversed(range(reward.shape[1])):
        following = reward[:, t] + discount * torch.where(done[:, t], beyond[:, t], following)
        returns[:, t] = following
    return returns


def foresight_figure(foresight: Foresight, title: str = "") -> Figure:
    """Two panels: returns against predictions, and how often the critic's intervals hold.

    Args:
        foresight: what to draw.
        title: e.g. the task.
    """
    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    if title:
        figure.suptitle(title)
    left, right = figure.subplots(1, 2)
    ends = [min(foresight.mean.min(), foresight.realised.min())]
    ends.append(max(foresight.mean.max(), foresight.realised.max()))
    left.errorbar(
        foresight.mean,
        foresight.realised,
        xerr=1.96 * foresight.stddev,
        fmt=".",
        markersize=3,
        elinewidth=0.3,
        alpha=0.4,
        color=COLOUR,
    )
    left.plot(ends, ends, color="0.35", linestyle="--", linewidth=1)
    left.set(xlabel="predicted value, with 95 % interval", ylabel="return that came", title="foresight")
    right.plot([0, 1], [0, 1], color="0.35", linestyle="--", linewidth=1, label="calibrated")
    right.plot(LEVELS, foresight.coverage(), marker="o", markersize=3, color=COLOUR, label="critic")
    right.set(xlabel="probability of the interval", ylabel="share of returns inside", title="calibration")
    right.set(xlim=(0, 1), ylim=(0, 1))
    right.legend(frameon=False, fontsize="small", loc="upper left")
    for axes in (left, right):
        axes.title.set_size("medium")
        open_frame(axes)
    return figure
