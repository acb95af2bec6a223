"""The temporal differences of all experience: closed forms, slopes, terminal states, today's policy."""

import torch
from torch import Tensor

from torch_gprl.critics import GPActionValue
from torch_gprl.critics.difference_equations import DifferenceEquations, Transitions
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.gp.prescribed import adopt_basis
from torch_gprl.kernels import Matern

LEARNERS, STEPS, DISCOUNT = 2, 60, 0.9


def critic(noise: float = 1e-6) -> GPActionValue:
    kernel = Matern(3, 2.0, batch_shape=(LEARNERS,), smoothness=2.5).requires_grad_(False)
    return GPActionValue(SparseOnlineGP(kernel, budget=STEPS, noise_variance=noise, overshoot=1))


def random_transitions(**columns: Tensor) -> Transitions:
    draws = torch.rand(LEARNERS, STEPS, 6, dtype=torch.float64)
    given = {
        "observation": draws[..., :2],
        "action": draws[..., 2:3],
        "next_observation": draws[..., 3:5],
        "reward": draws[..., 5],
        "terminated": torch.zeros(LEARNERS, STEPS, dtype=torch.bool),
    }
    return Transitions(**(given | columns))


def equations(process: GPActionValue, data: Transitions) -> DifferenceEquations:
    adopt_basis(process.gp, process.inputs(data.observation, data.action))
    return DifferenceEquations(process, data, DISCOUNT)


def test_rewards_for_ever_add_up_to_a_geometric_series():
    data = random_transitions(reward=torch.ones(LEARNERS, STEPS, dtype=torch.float64))
    data = data._replace(next_observation=data.observation)  # nothing ever changes
    process = critic()
    equations(process, data).solve(data.action)
    value = process.mean_value(data.observation, data.action)
    torch.testing.assert_close(value, torch.full_like(value, 1 / (1 - DISCOUNT)), atol=0, rtol=1e-3)


def test_a_terminal_transition_is_worth_its_reward_whatever_comes_next():
    data = random_transitions(terminated=torch.ones(LEARNERS, STEPS, dtype=torch.bool))
    data = data._replace(reward=data.observation.sum(-1))
    process = critic()
    system = equations(process, data)
    system.solve(torch.zeros(LEARNERS, STEPS, 1, dtype=torch.float64))
    value = process.mean_value(data.observation, data.action)
    torch.testing.assert_close(value, data.reward, atol=1e-3, rtol=0)


def test_the_values_satisfy_bellmans_equation_of_the_policy_that_is_asked_for():
    """A smooth value, seen through rewards that it would give under another policy's data."""

    def value(observation: Tensor, action: Tensor) -> Tensor:
        return observation.sin().sum(-1) + 0.3 * action.squeeze(-1)

    process, data = critic(), random_transitions()
    for next_action in (torch.zeros_like(data.action), data.action.flip(1)):
        reward = value(data.observation, data.action) - DISCOUNT * value(data.next_observation, next_action)
        equations(process, data._replace(reward=reward)).solve(next_action)
        found = process.mean_value(data.observation, data.action)
        torch.testing.assert_close(found, value(data.observation, data.action), atol=0.03, rtol=0)


def test_slopes_are_those_of_the_solved_value():
    process, data = critic(1e-3), random_transitions()
    process.input_scale[..., -1] = 2.0
    action = torch.rand(LEARNERS, STEPS, 1, dtype=torch.float64, requires_grad=True)
    slopes = equations(process, data).solve(action.detach())
    value = process.mean_value(data.next_observation, action)
    (gradient,) = torch.autograd.grad(value.sum(), action)
    torch.testing.assert_close(slopes.gradient, 2.0 * gradient)  # of the scaled action


def test_a_terminal_state_counts_as_a_step_without_reward():
    terminated = torch.zeros(LEARNERS, STEPS, dtype=torch.bool)
    terminated[:, ::3] = True
    data = random_transitions(terminated=terminated)
    mean, variance = data.reward_moments()
    for learner in range(LEARNERS):
        rewards = torch.cat([data.reward[learner], torch.zeros(STEPS // 3, dtype=torch.float64)])
        torch.testing.assert_close(mean[learner], rewards.mean())
        torch.testing.assert_close(variance[learner], rewards.var(correction=0))
