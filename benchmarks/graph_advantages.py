"""Do critics on a graph of experience know which actions are better? Correlation with true advantages.

    python -m benchmarks.graph_advantages [--batches 4] [--out runs/graph-advantages]

At the fixed policies of `gradient_quality` on Pendulum-v1, critics learn one batch of 5 episodes, from
returns or from temporal differences; then their advantages are compared with those of brute force. The last
one stands on a graph of states and actions: it follows what an action leads to, where the others multiply a
kernel of states by one of actions.
Leaves graph_advantages.json in --out.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import torch
import tyro
from torch import Tensor

from benchmarks.gradient_arms import fit_gaussian
from benchmarks.gradient_data import EPISODES, SETTINGS, Batches, Fixed, batches, fixed_policies
from benchmarks.gradient_truth import Branches, branches
from torch_gprl.critics import KernelName, correlation
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.graphs import Experience
from torch_gprl.kernels import SuccessorWithRest
from torch_gprl.learners import PolicyGradientConfig
from torch_gprl.learners.config import Targets

KERNELS: tuple[KernelName, ...] = ("squared-exponential", "matern-3/2", "geodesic", "successor")
TARGETS: tuple[Targets, ...] = ("returns", "differences")
BRANCHES_SEED = 3_000_000
NOISE = 1e-2  # of the variance of rewards
VALUES_VARY_OVER = (1.0, 4.0)  # standard deviations of states, halves of the actuator's range


@dataclass(frozen=True)
class Options:
    """What to compare."""

    batches: int = 4  # independent ones, each with critics of its own
    episodes: int = EPISODES  # of each batch
    budget: int = 200  # basis vectors
    out: Path = field(default_factory=lambda: Path("runs/graph-advantages"))  # where results and policies go


def main(options: Options) -> None:
    """Fit critics, print and leave their correlations."""
    torch.set_num_threads(1)
    setting, found = SETTINGS[0], {}
    for fixed in fixed_policies(setting, options.out / "policies"):
        truth = branches(fixed, BRANCHES_SEED)
        seen = batches(fixed, options.batches, 7, options.episodes)
        title = f"{fixed.name} policy (return {fixed.mean_return:.0f})"
        found[title] = {}
        for name, values in correlations(fixed, seen, truth, options):
            found[title][name] = values.tolist()
            print(f"{title}, {name}: {float(values.mean()):.2f} {[round(v, 2) for v in values.tolist()]}")
    (options.out / "graph_advantages.json").write_text(json.dumps(found, indent=1) + "\n")


def correlations(
    fixed: Fixed, seen: Batches, truth: Branches, options: Options
) -> Iterator[tuple[str, Tensor]]:
    """Each critic's name, and the correlation of its advantages with the true ones in every batch."""
    for kernel, targets in product(KERNELS, TARGETS):
        numbers = PolicyGradientConfig(
            kernel=kernel,
            targets=targets,
            budget=options.budget,
            discount=fixed.setting.discount,
            visited=seen.data[0].numel(),
        )
        yield f"{kernel}, {targets}", truth.correlation(fit_gaussian(seen, numbers))
    yield (
        "successor on (s, a), differences",
        torch.stack(
            [on_states_and_actions(fixed, seen, index, truth, options) for index in range(options.batches)]
        ),
    )


def on_states_and_actions(
    fixed: Fixed, seen: Batches, index: int, truth: Branches, options: Options
) -> Tensor:
    """The same for a process on a graph of states and actions, taught r = Q(s, a) − γ Q(s', mean action)."""
    data, head = seen.data[index], seen.policy.head
    with torch.no_grad():
        following = head.parameters_at(seen.data["next", "observation"])[0][index]
    half = float(head.half_range.flatten()[0])
    unit = torch.cat([data["observation"].flatten(0, 1).std(0), torch.full((1,), half)]).double()

    def inputs(observation: Tensor, action: Tensor) -> Tensor:
        return torch.cat([observation, action.clamp(-half, half)], -1).double().flatten(0, 1) / unit

    x, after = inputs(data["observation"], data["action"]), inputs(data["next", "observation"], following)
    reward = data["next", "reward"].double().flatten()
    reward = (reward - reward.mean()) / seen.true_return[index].std()
    visited = Experience(x.shape[-1], len(x) + 1)
    visited.add(x, after)
    kernel = SuccessorWithRest(visited, fixed.setting.discount)
    state, action = VALUES_VARY_OVER
    kernel.suit(x.new_tensor([*[state] * (x.shape[-1] - 1), action]))
    gp = SparseOnlineGP(kernel, options.budget, NOISE * float(reward.var()))
    gp.update(x, reward, next_inputs=after, discount=fixed.setting.discount)
    with torch.no_grad():
        estimate = gp.posterior(inputs(truth.observation, truth.action)).mean.reshape(truth.mean_return.shape)
    parts = (values - values.mean(-1, keepdim=True) for values in (estimate, truth.mean_return.double()))
    return correlation(*(part.flatten() for part in parts))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
