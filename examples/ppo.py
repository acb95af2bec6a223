"""The Gaussian-process critic inside TorchRL's own PPO: actor, collector and loss are TorchRL's.

Run it: `python examples/ppo.py`
"""

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, NormalParamExtractor, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from torch_gprl.critics import GPActionValue, GPStateValue, GPValueEstimator
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential


def train(updates: int = 40, copies: int = 8, steps: int = 200, epochs: int = 10) -> list[float]:
    """PPO on Gymnasium's pendulum; returns the mean return per episode of each update."""
    torch.manual_seed(0)
    env = TransformedEnv(SerialEnv(copies, lambda: GymEnv("Pendulum-v1")), RewardSum())
    env.set_seed(0)
    network = nn.Sequential(MLP(3, 2, num_cells=(64, 64)), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    gp = SparseOnlineGP(SquaredExponential(input_dim=3 + 1), budget=150, noise_variance=0.1)
    critic = GPActionValue(gp, action_low=torch.tensor([-2.0]), action_high=torch.tensor([2.0]))
    estimator = GPValueEstimator(critic, actor, discount=0.95, estimator="generalised", horizon=steps)
    loss = ClipPPOLoss(actor, critic_network=GPStateValue(critic, actor), critic_coeff=None)

    optimiser = torch.optim.Adam(actor.parameters(), lr=1e-3)
    returns: list[float] = []
    frames = {"frames_per_batch": copies * steps, "total_frames": updates * copies * steps}
    for rollout in Collector(env, actor, auto_register_policy_transforms=False, **frames):
        estimator(rollout)  # advantages by the critic as it stood before this rollout
        for _ in range(epochs):
            for batch in rollout.reshape(-1)[torch.randperm(copies * steps)].split(200):
                losses = loss(batch)
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_entropy"]).backward()
                optimiser.step()
        critic.standardise(rollout["observation"], rollout["action"], rollout["value_target"])
        critic.update(rollout)
        returns.append(rollout["next", "episode_reward"][rollout["next", "done"]].mean().item())
        print(f"update {len(returns)}: return {returns[-1]:.0f}, {int(gp.size)} basis vectors")
    return returns


if __name__ == "__main__":
    train()
