"""What a critic thinks of the states of a plane: the numbers behind the picture of a value function."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_gprl.runs.figures import Surface

GRID = 61  # points of the plane in each direction
POINTS_AT_ONCE = 500  # of the plane, for each learner: bounds the memory


@runtime_checkable
class PicturePlane(Protocol):
    """Two coordinates that fix the whole observation, as the tasks of `envs` name them."""

    labels: tuple[str, str]
    low: tuple[float, float]
    high: tuple[float, float]
    to_observation: Callable[[Tensor], Tensor]
    from_observation: Callable[[Tensor], Tensor]


@torch.no_grad()
def value_on_plane(
    critic: Any,  # noqa: ANN401  (a critic with a Gaussian process: this floor knows none)
    policy: TensorDictModuleBase,
    plane: PicturePlane,
    learner: int,
    learners: int,
) -> Surface:
    """One learner's posterior of V(s) = Q(s, f(s)) on a grid of a plane of states.

    Args:
        critic: has `value(observation, action)` and `basis_points(learner)`, which begin with observations.
        policy: its deterministic action is f(s).
        plane: where to look.
        learner: whose value.
        learners: how many critic and policy are made for.
    """
    basis = critic.basis_points(learner)
    x, y = (torch.linspace(low, high, GRID) for low, high in zip(plane.low, plane.high, strict=True))
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2).to(basis.device)
    observations = plane.to_observation(points).float()
    means, variances = [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for some in observations.split(POINTS_AT_ONCE):
            states = TensorDict(
                {"observation": some.expand(learners, -1, -1)}, batch_size=(learners, len(some))
            )
            value = critic.value(states["observation"], policy(states)["action"])
            means.append(value.mean[learner])
            variances.append(value.variance[learner])
    return Surface(
        x=x.double().numpy(),
        y=y.double().numpy(),
        mean=torch.cat(means).double().cpu().numpy().reshape(GRID, GRID),
        stddev=torch.cat(variances).double().sqrt().cpu().numpy().reshape(GRID, GRID),
        basis=plane.from_observation(basis[:, : observations.shape[-1]]).double().cpu().numpy(),
        labels=plane.labels,
    )
