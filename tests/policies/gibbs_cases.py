"""Critics, controllers and states for the tests of Gibbs exploration, and its density written out plainly."""

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.policies import GibbsConfig, GibbsPolicy, LinearController, NoiseStream, ScaledController

STATES = 2


def box(actions: int) -> tuple[Tensor, Tensor]:
    """Bounds of an actuator whose middle is not zero."""
    return torch.linspace(-1.0, -2.0, actions), torch.linspace(2.0, 3.0, actions)


def taught_critic(actions: int, learners: int = 1, seed: int = 0) -> GPActionValue:
    """An action value with hills and valleys, some of it negative."""
    generator = torch.Generator().manual_seed(seed)
    low, high = box(actions)
    kernel = SquaredExponential(STATES + actions, 1.2, batch_shape=(learners,))
    critic = GPActionValue(SparseOnlineGP(kernel, 40, 1e-2), action_low=low, action_high=high)
    states = torch.randn(learners, 60, STATES, generator=generator)
    chosen = low + (high - low) * torch.rand(learners, 60, actions, generator=generator)
    target = 2 * torch.randn(learners, 60, 1, generator=generator) - 5
    data = TensorDict({"observation": states, "action": chosen, "value_target": target}, (learners, 60))
    critic.standardise(states, chosen, target)
    critic.update(data)
    return critic


def gibbs(
    actions: int, config: GibbsConfig | None = None, learners: int = 1, seed: int | None = 0
) -> GibbsPolicy:
    """A Gibbs policy round a linear controller with random weights, in float64."""
    linear = LinearController(STATES, actions, (learners,))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        linear.weight.copy_(0.3 * torch.randn(STATES, actions, generator=generator))
    low, high = box(actions)
    noise = None if seed is None else NoiseStream(seed, range(learners))
    greedy = ScaledController(linear, low, high)
    return GibbsPolicy(greedy, taught_critic(actions, learners), config, noise).double()


def here(count: int, learners: int = 1) -> TensorDict:
    """The same state many times."""
    state = torch.tensor([0.4, -0.3], dtype=torch.float64).expand(learners, count, STATES)
    return TensorDict({"observation": state}, (learners, count))


def plain_log_density(policy: GibbsPolicy, state: Tensor, action: Tensor, value_range: Tensor) -> Tensor:
    """Equation (.16), or its robust sibling, of the first learner, at actions [P, A], up to a constant."""
    head = policy.head
    value = head.critic.value(state.expand(1, len(action), -1), action.unsqueeze(0)).mean[0]
    preference = (value - value_range.min()) / (value_range.max() - value_range.min())
    low, high = box(action.shape[-1])
    width = head.config.width * (high - low).double() / 2
    square = ((action - head.mean_at(state).reshape(-1)) / width).square().sum(-1)
    β = head.inverse_temperature
    if head.config.form == "printed":
        return β * preference * (-square / 2).exp()
    return β * preference - square / 2
