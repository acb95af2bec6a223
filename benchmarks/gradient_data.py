"""Fixed policies and the batches of experience that gradient estimators are compared on.

A policy is a snapshot of a short training, picked by its return, so that "mid" and "good" mean the same on
every machine. A batch is a few episodes from the start, cut at a time limit; the simulation goes on behind
the cut, so that the true discounted return of every step is known and no estimator sees it.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.learners.config import ControllerForm
from torch_gprl.policies import GaussianPolicy, MLPController, RBFController, gaussian_policy
from torch_gprl.runs import evaluate

EPISODES, STEPS = 5, 200  # of a batch
TAIL = 150  # steps behind the cut that only pay: γ^150 is 1 % for γ = 0.97
TRAINED_SIDE_BY_SIDE, TRAINING_ENVS, JUDGING_EPISODES = 4, 8, 20
CENTRES = 100  # of the radial basis functions


@dataclass(frozen=True)
class Setting:
    """A task and how its policies are made.

    Args:
        task: id of the task.
        controller: form of the controller.
        frames: environment steps of the training, for each of a few learners.
        returns: mean returns of the policies to pick, by name; unless given those at 50 % and 90 % of the way
            from the first policy to the best.
        std: exploration standard deviation, fixed, in halves of the actuator's range.
        discount: γ.
    """

    task: str
    controller: ControllerForm
    frames: int
    returns: dict[str, float] | None = None
    std: float = 0.6
    discount: float = 0.97


SETTINGS = (
    Setting("Pendulum-v1", "rbf", 48_000, {"mid": -925.0, "good": -260.0}),
    Setting("cartpole-swingup", "mlp", 80_000),
    Setting("atwood", "mlp", 80_000),
)


@dataclass(frozen=True)
class Fixed:
    """A policy of one learner that stays as it is: its state, its return without exploration."""

    setting: Setting
    name: str
    controller: dict[str, Tensor]
    mean_return: float

    def policy(self, learners: int, seed: int, env: envs.BatchEnv) -> GaussianPolicy:
        """The same policy for every learner, each with parameters and noise of its own."""
        dims = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
        form = RBFController if self.setting.controller == "rbf" else MLPController
        controller = form(*dims, (learners,))
        controller.load_state_dict(
            {key: tensor.expand(learners, *tensor.shape) for key, tensor in self.controller.items()}
        )
        policy = gaussian_policy(
            controller, env.action_spec, self.setting.std, seed, learners=range(learners)
        )
        policy.head.log_std.requires_grad_(False)
        return policy


def fixed_policies(setting: Setting, cache: Path) -> list[Fixed]:
    """The policies of a setting, trained once and then read from `cache`."""
    path = cache / f"{setting.task}-{setting.controller}-{setting.std}-{setting.discount}.pt"
    if path.exists():
        saved = torch.load(path, weights_only=True)
        return [Fixed(setting, name, *entry) for name, entry in saved.items()]
    snapshots = _train(setting)
    wanted = setting.returns
    if wanted is None:
        first, best = snapshots[0][1], max(value for _, value in snapshots)
        wanted = {"mid": first + 0.5 * (best - first), "good": first + 0.9 * (best - first)}
    picked = {
        name: min(snapshots, key=lambda snapshot: abs(snapshot[1] - aim)) for name, aim in wanted.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(picked, path)
    return [Fixed(setting, name, *entry) for name, entry in picked.items()]


def _train(setting: Setting) -> list[tuple[dict[str, Tensor], float]]:
    """Controllers and their mean returns after every update of a training."""
    learners = TRAINED_SIDE_BY_SIDE
    env = envs.make(setting.task, learners=learners, num_envs=TRAINING_ENVS, seed=5, threads=1)
    judge = envs.make(setting.task, learners=learners, num_envs=JUDGING_EPISODES, seed=77, threads=1)
    numbers = PolicyGradientConfig(
        total_frames=setting.frames,
        controller=setting.controller,
        std=setting.std,
        exploration="fixed",
        discount=setting.discount,
    )
    learner = PolicyGradient(env, numbers, seed=1)
    snapshots = []
    for _ in learner.train():
        controller = learner.policy.head.controller.state_dict()
        returns = evaluate(judge, learner.policy).mean(1).tolist()
        for index, value in enumerate(returns):
            snapshots.append(({key: tensor[index].clone() for key, tensor in controller.items()}, value))
    return snapshots


@dataclass(frozen=True)
class Batches:
    """One independent batch for each learner: `data` [learners, episodes, steps], and what only we know.

    Args:
        data: as a collector gives it; the last step of each episode is truncated.
        true_return: discounted return of every step, rewards behind the cut included.
        policy: that made it, parameters [learners, ...].
    """

    data: TensorDict
    true_return: Float[Tensor, "learners episodes steps"]
    policy: GaussianPolicy


def batches(fixed: Fixed, learners: int, seed: int, episodes: int = EPISODES) -> Batches:
    """Independent batches of a policy, as many as `learners`."""
    length, discount = STEPS + TAIL, fixed.setting.discount
    env = envs.make(
        fixed.setting.task, learners=learners, num_envs=episodes, seed=seed, threads=1, horizon=length + 1
    )
    policy = fixed.policy(learners, seed, env)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(length, policy, break_when_any_done=False)
    reward = data["next", "reward"].squeeze(-1).double()
    done = data["next", "done"].squeeze(-1)
    returns, ahead = torch.empty_like(reward), torch.zeros_like(reward[..., 0])
    for step in reversed(range(length)):
        ahead = reward[..., step] + discount * torch.where(done[..., step], 0.0, ahead)
        returns[..., step] = ahead
    cut = data[..., :STEPS].clone()
    for key in ("truncated", "done"):
        cut["next", key][..., -1, :] = True
    return Batches(cut, returns[..., :STEPS].clone(), policy)
