"""The policy-gradient loss: its value, its gradient, and learners that do not meet."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import GaussianPolicy, MLPController, gaussian_policy

LEARNERS, ENVS, STEPS = 3, 2, 5


def policy(learners: int = LEARNERS) -> GaussianPolicy:
    controller = MLPController(4, 2, (learners,), hidden=(6,)).double()
    with torch.no_grad():
        for parameter in controller.parameters():
            parameter.normal_(std=0.5)
    return gaussian_policy(controller, Bounded(-2.0, 2.0, shape=(2,), dtype=torch.float64))


def rollout(*shape: int) -> TensorDict:
    data = {
        "observation": torch.randn(*shape, 4, dtype=torch.float64),
        "action": torch.randn(*shape, 2, dtype=torch.float64),
        "advantage": torch.randn(*shape, 1, dtype=torch.float64),
    }
    return TensorDict(data, shape)


def gradients(acting: GaussianPolicy, data: TensorDict, **options: bool) -> dict[str, Tensor]:
    loss = PolicyGradientLoss(acting, **options)(data)["loss_objective"]
    names, parameters = zip(*acting.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(loss, parameters), strict=True))


@pytest.mark.parametrize("shape", [(LEARNERS, 7), (LEARNERS, ENVS, STEPS)])
def test_it_is_the_mean_of_scored_advantages_summed_over_learners(shape):
    acting, data = policy(), rollout(*shape)
    log_prob = acting.get_dist(data).log_prob(data["action"])
    expected = -sum((log_prob * data["advantage"].squeeze(-1))[i].mean() for i in range(LEARNERS))
    out = PolicyGradientLoss(acting)(data)
    assert list(out.keys()) == ["loss_objective"]
    assert out["loss_objective"].shape == ()
    torch.testing.assert_close(out["loss_objective"], expected)


def test_its_gradient_is_that_of_finite_differences():
    acting, data = policy(), rollout(LEARNERS, ENVS, STEPS)
    loss = PolicyGradientLoss(acting)
    found = gradients(acting, data)
    for name, parameter in acting.named_parameters():
        direction = torch.randn_like(parameter)
        ends = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                parameter.add_(step * direction)
                ends.append(loss(data)["loss_objective"])
                parameter.sub_(step * direction)
        slope = (ends[0] - ends[1]) / 2e-5
        torch.testing.assert_close((found[name] * direction).sum(), slope, rtol=1e-7, atol=1e-8)


def test_the_gradient_reaches_the_policys_own_parameters():
    acting = policy()
    PolicyGradientLoss(acting)(rollout(LEARNERS, 7))["loss_objective"].backward()
    for parameter in acting.parameters():
        assert parameter.grad is not None
        assert parameter.grad.flatten(1).any(1).all()


def test_the_gradient_of_a_learner_does_not_depend_on_the_others():
    acting, data = policy(), rollout(LEARNERS, ENVS, STEPS)
    before = gradients(acting, data)
    data[1:] = rollout(LEARNERS - 1, ENVS, STEPS)
    after = gradients(acting, data)
    alone = policy(1)
    alone.load_state_dict(
        {
            key: tensor[:1] if tensor.shape[:1] == (LEARNERS,) else tensor
            for key, tensor in acting.state_dict().items()
        }
    )
    single = gradients(alone, data[:1])
    for name, gradient in before.items():
        torch.testing.assert_close(after[name][0], gradient[0])
        torch.testing.assert_close(single[name][0], gradient[0])
        assert not torch.equal(after[name][1], gradient[1])


def test_without_learners_it_is_one_mean():
    acting, data = policy(), rollout(LEARNERS, ENVS, STEPS)
    together = gradients(acting, data, learners=False)
    for name, gradient in gradients(acting, data).items():
        torch.testing.assert_close(together[name], gradient / LEARNERS)


def test_the_advantage_is_held_constant():
    acting, data = policy(), rollout(LEARNERS, 7)
    data["advantage"].requires_grad_()
    PolicyGradientLoss(acting)(data)["loss_objective"].backward()
    assert data["advantage"].grad is None


def test_single_precision_advantages_and_double_precision_ones_weigh_alike():
    acting, data = policy(), rollout(LEARNERS, 7)
    data["advantage"] = data["advantage"].float()
    single = PolicyGradientLoss(acting)(data)["loss_objective"]
    data["advantage"] = data["advantage"].double()
    assert single.dtype == torch.float64
    torch.testing.assert_close(single, PolicyGradientLoss(acting)(data)["loss_objective"])


def test_its_keys_can_be_renamed():
    acting, data = policy(), rollout(LEARNERS, 7)
    loss = PolicyGradientLoss(acting)
    expected = loss(data)["loss_objective"]
    loss.set_keys(advantage="weight", action="torque")
    assert loss.in_keys == ["observation", "torque", "weight"]
    renamed = data.rename_key_("advantage", "weight").rename_key_("action", "torque")
    assert torch.equal(loss(renamed)["loss_objective"], expected)
