"""The averaged policy: which parameters act when, and what their mean is."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type

from torch_gprl.policies import AveragedPolicy, LinearController, gaussian_policy

LEARNERS = 2


def made(steps: int) -> AveragedPolicy:
    spec = Bounded(-2 * torch.ones(1), 2 * torch.ones(1), shape=(1,), dtype=torch.float32)
    plain = gaussian_policy(LinearController(3, 1, (LEARNERS,)), spec, seed=0, learners=range(LEARNERS))
    return AveragedPolicy(plain.head, plain.noise, steps)


def after(policy: AveragedPolicy, *values: float) -> AveragedPolicy:
    """Let it follow steps that set the weights to these values."""
    for value in values:
        with torch.no_grad():
            policy.head.controller.weight.fill_(value)
        policy.follow()
    return policy


def act(policy: AveragedPolicy, kind: ExplorationType) -> TensorDict:
    with set_exploration_type(kind):
        return policy(TensorDict({"observation": torch.ones(LEARNERS, 4, 3)}, [LEARNERS, 4]))


@pytest.mark.parametrize(
    ("steps", "mean"),
    [(1, 8.0), (2, ((2 + 4) / 2 + 6) / 4 + 8 / 2), (3, (2 + 4 + 6) / 3 * 2 / 3 + 8 / 3), (9, 5.0)],
)
def test_first_steps_weigh_alike_and_later_ones_exponentially(steps, mean):
    policy = after(made(steps), 2.0, 4.0, 6.0, 8.0)
    torch.testing.assert_close(policy.averaged.controller.weight, torch.full((LEARNERS, 3, 1), mean))


def test_the_mean_acts_without_exploration_and_the_newest_parameters_explore():
    policy = after(made(2), 0.1, 0.3)
    loc = {kind: act(policy, kind)["loc"] for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC)}
    torch.testing.assert_close(loc[ExplorationType.RANDOM], torch.full((LEARNERS, 4, 1), 3 * 0.3 * 2))
    torch.testing.assert_close(loc[ExplorationType.DETERMINISTIC], torch.full((LEARNERS, 4, 1), 3 * 0.2 * 2))
    written = act(policy, ExplorationType.DETERMINISTIC)
    torch.testing.assert_close(written["action"], written["loc"])
    peak = torch.distributions.Normal(written["loc"], written["scale"]).log_prob(written["loc"]).sum(-1)
    torch.testing.assert_close(written["action_log_prob"], peak)


def test_the_mean_is_saved_and_not_trained():
    policy, other = after(made(4), 1.0, 2.0), made(4)
    other.load_state_dict(policy.state_dict())
    for one in (policy, other):
        after(one, 6.0)
    torch.testing.assert_close(other.averaged.controller.weight, torch.full((LEARNERS, 3, 1), 3.0))
    assert not any(parameter.requires_grad for parameter in policy.averaged.parameters())
    with pytest.raises(ValueError, match="at least 1 step, got 0"):
        made(0)
