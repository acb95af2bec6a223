"""Tabular Q-learning on a grid of states and actions: what the thesis compares GP Q-learning with (R2).

Watkins and Dayan (1992): Q(c, a) += rate (r + γ max_a' Q(c', a') − Q(c, a)) for the cell c of a state, with
the rate 1/n of the n-th visit, but never below a floor, since targets move. States are cut into cells along
the two coordinates of a task's picture plane. All learners at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.policies.gaussian import explores

LEAST_RATE = 0.1  # of learning: averages over about ten visits


@dataclass(frozen=True)
class Grid:
    """How fine the table is."""

    cells: int  # along each of the two coordinates
    actions: int  # evenly spaced from bound to bound


class Table(TensorDictModuleBase):
    """Q of every cell and action, and the ε-greedy policy on it; greedy under `DETERMINISTIC`.

    Args:
        env: environment of batch [learners, 1], of a task with a picture plane and one action.
        grid: how fine.
        epsilon: probability of a random action.
        seed: of the exploration.
    """

    def __init__(self, env: envs.BatchEnv, grid: Grid, epsilon: float, seed: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action", "chosen"]
        if env.plane is None:
            raise ValueError(f"{env.task.id} has no picture plane; choose a task of two coordinates")
        learners, self.plane, self.grid, self.epsilon = env.batch_size[0], env.plane, grid, epsilon
        low, high = env.task.action_low[0], env.task.action_high[0]
        self.actions = torch.linspace(low, high, grid.actions)
        self.generator = torch.Generator().manual_seed(seed)
        self.value = torch.zeros(learners, grid.cells**2, grid.actions, dtype=torch.float64)
        self.visits = torch.zeros_like(self.value)

    def cell(self, observation: Float[Tensor, "learners envs S"]) -> Int[Tensor, "learners envs"]:
        """Number of the cell of each state; states off the plane belong to the cells at its edge."""
        point = self.plane.from_observation(observation)
        low, high = torch.tensor(self.plane.low), torch.tensor(self.plane.high)
        place = ((point - low) / (high - low) * self.grid.cells).long().clamp(0, self.grid.cells - 1)
        return place[..., 0] * self.grid.cells + place[..., 1]

    def at(self, cell: Tensor) -> Float[Tensor, "learners envs A"]:
        """Values of all actions in these cells."""
        return self.value.gather(1, cell.unsqueeze(-1).expand(-1, -1, self.grid.actions))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and its number."""
        cell = self.cell(tensordict.get("observation"))
        value = self.at(cell)
        if explores():
            # what is tied is chosen by chance, not by its number
            value = value + 1e-9 * torch.rand(value.shape, generator=self.generator, dtype=value.dtype)
        chosen = value.argmax(-1)
        if explores():
            stray = torch.rand(cell.shape, generator=self.generator) < self.epsilon
            anything = torch.randint(self.grid.actions, cell.shape, generator=self.generator)
            chosen = torch.where(stray, anything, chosen)
        return tensordict.set("action", self.actions[chosen].unsqueeze(-1)).set(
            "chosen", chosen.unsqueeze(-1)
        )

    def learn(self, step: TensorDictBase, discount: float) -> None:
        """One step [learners, 1] of experience of every learner."""
        following = step.get("next")
        beyond = self.at(self.cell(following.get("observation"))).amax(-1, keepdim=True)
        terminated, reward = following.get("terminated"), following.get("reward")
        target = reward + discount * torch.where(terminated, 0.0, beyond)
        learner = torch.arange(len(self.value))
        where = learner, self.cell(step.get("observation"))[:, 0], step.get("chosen")[:, 0, 0]
        self.visits[where] += 1
        rate = (1 / self.visits[where]).clamp_min(LEAST_RATE)
        self.value[where] += rate * (target[:, 0, 0] - self.value[where])


class TabularQ:
    """Tabular Q-learning of every learner of an environment, a step at a time.

    Args:
        env: environment of batch [learners, 1].
        grid: how fine the table is.
        total_frames: environment steps per learner.
        discount: γ per environment step.
        epsilon: probability of a random action.
        seed: of the exploration.
    """

    def __init__(
        self,
        env: envs.BatchEnv,
        grid: Grid,
        total_frames: int,
        discount: float,
        epsilon: float = 0.1,
        seed: int = 0,
    ) -> None:
        self.env, self.total_frames, self.discount = env, total_frames, discount
        self.policy = Table(env, grid, epsilon, seed)
        self.frames = 0

    def train(self) -> Iterator[None]:
        """Stops after every step."""
        state = self.env.reset()
        while self.frames < self.total_frames:
            with set_exploration_type(ExplorationType.RANDOM):
                step, state = self.env.step_and_maybe_reset(self.policy(state))
            self.policy.learn(step, self.discount)
            self.frames += 1
            yield
