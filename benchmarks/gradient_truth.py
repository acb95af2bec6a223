"""True advantages by brute force: several first actions from one state, each followed by the same noise.

A critic may explain nearly all of Q and nothing of the advantage, the only thing that a policy gradient uses.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor

import envs
from benchmarks.gradient_data import STEPS, TAIL, Fixed
from torch_gprl.critics import GPActionValue, correlation
from torch_gprl.policies import GaussianPolicy

STATES, ACTIONS, REPEATS = 32, 6, 16


@dataclass(frozen=True)
class Branches:
    """States of a policy's episodes, actions that it might take there, and what they return."""

    observation: Float[Tensor, "states actions D"]
    action: Float[Tensor, "states actions A"]
    mean_return: Float[Tensor, "states actions"]

    def correlation(self, critic: GPActionValue) -> Float[Tensor, " learners"]:
        """Correlation of each learner's advantages with the true ones, over all states and actions."""
        learners = len(critic.gp.size)
        data = (part.expand(learners, *part.shape) for part in (self.observation, self.action))
        with torch.no_grad():
            estimated = critic.mean_value(*data)
        return correlation(_centred(estimated), _centred(self.mean_return).expand(learners, -1))


def _centred(values: Float[Tensor, "*batch states actions"]) -> Float[Tensor, "*batch points"]:
    return (values - values.mean(-1, keepdim=True)).flatten(-2)


@torch.no_grad()
def branches(fixed: Fixed, seed: int) -> Branches:
    """States spread evenly over the steps of an episode, each from an episode of its own."""
    one = envs.make(fixed.setting.task, learners=1, num_envs=STATES, seed=seed, threads=1, horizon=STEPS + 1)
    policy = fixed.policy(1, seed, one)
    torch.manual_seed(seed)
    positions, speeds = _visited(one, policy)
    copies = STATES * ACTIONS * REPEATS
    many = envs.make(fixed.setting.task, learners=1, num_envs=copies, seed=seed, threads=1, horizon=TAIL + 1)

    def every(values: Tensor) -> Tensor:
        return values[:, None, None].expand(-1, ACTIONS, REPEATS, -1).reshape(1, copies, -1)

    observation = many.place(every(positions), every(speeds))["observation"]
    first = torch.randn(STATES, ACTIONS, 1, one.action_spec.shape[-1])
    loc, scale = policy.head.parameters_at(observation)
    action = loc + scale * first.expand(-1, -1, REPEATS, -1).reshape(loc.shape)
    returned = _returns(many, policy, action, fixed.setting.discount)
    shape = (STATES, ACTIONS, REPEATS)
    return Branches(
        observation.reshape(*shape, -1)[:, :, 0],
        action.reshape(*shape, -1)[:, :, 0],
        returned.reshape(shape).mean(-1),
    )


def _visited(env: envs.BatchEnv, policy: GaussianPolicy) -> tuple[Tensor, Tensor]:
    """Positions and speeds of environment i at step i · STEPS / STATES, [states, ...] each."""
    state, positions, speeds = env.reset(), [], []
    for step in range(STEPS):
        here = slice(step * STATES // STEPS, (step + 1) * STATES // STEPS)
        positions.append(env.qpos[0, here])
        speeds.append(env.qvel[0, here])
        state = env.step_and_maybe_reset(policy(state))[1]
    return torch.cat(positions), torch.cat(speeds)


def _returns(
    env: envs.BatchEnv, policy: GaussianPolicy, action: Tensor, discount: float
) -> Float[Tensor, " copies"]:
    """Discounted return of a first action and of the policy after it, with the same noise for all actions."""
    total = torch.zeros(action.shape[1], dtype=torch.float64)
    weight = torch.ones_like(total)
    for _ in range(TAIL):
        step = env.step(TensorDict({"action": action}, env.batch_size))["next"]
        total += weight * step["reward"].flatten().double()
        weight *= discount * ~step["done"].flatten()
        loc, scale = policy.head.parameters_at(step["observation"])
        noise = torch.randn(STATES, 1, REPEATS, action.shape[-1]).expand(-1, ACTIONS, -1, -1)
        action = loc + scale * noise.reshape(loc.shape)
    return total
