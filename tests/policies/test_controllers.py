"""Controllers: zero at the start, batched over learners, and what their formulas say."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torch_gprl.policies import Controller, LinearController, MLPController, RBFController

FORMS: list[tuple[type[Controller], dict[str, Any]]] = [
    (LinearController, {}),
    (RBFController, {"centres": 7}),
    (MLPController, {"hidden": (8, 6)}),
]
every_form = pytest.mark.parametrize(("form", "options"), FORMS, ids=["linear", "rbf", "mlp"])


def randomised(controller: Controller) -> Controller:
    """The controller in double precision with random parameters and standardisation."""
    controller.double()
    with torch.no_grad():
        for parameter in controller.parameters():
            parameter.normal_()
    loc = torch.randn_like(controller.observation_loc)
    controller.standardise(loc, 0.5 + torch.rand_like(loc))
    return controller


def learner(controller: Controller, index: int) -> dict[str, Tensor]:
    return {key: tensor[index] for key, tensor in controller.state_dict().items()}


@every_form
@pytest.mark.parametrize("batch", [(), (3,)])
def test_it_starts_at_zero_action(form, options, batch):
    observation = torch.randn(*batch, 5, 4, 6)
    action = form(6, 2, batch, **options)(observation)
    assert action.shape == (*batch, 5, 4, 2)
    assert not action.any()


@every_form
def test_each_learner_of_a_batch_is_a_controller_of_its_own(form, options):
    batch, single = randomised(form(6, 2, (3,), **options)), form(6, 2, **options).double()
    observation = torch.randn(3, 5, 4, 6, dtype=torch.float64)
    together = batch(observation)
    for index in range(3):
        single.load_state_dict(learner(batch, index))
        torch.testing.assert_close(together[index], single(observation[index]))


@every_form
def test_observations_are_standardised(form, options):
    controller = randomised(form(4, 1, **options))
    observation = torch.randn(9, 4, dtype=torch.float64)
    action = controller(observation)
    loc, scale = torch.randn(4, dtype=torch.float64), 0.1 + torch.rand(4, dtype=torch.float64)
    units = (observation - controller.observation_loc) / controller.observation_scale * scale + loc
    controller.standardise(loc, scale)
    torch.testing.assert_close(controller(units), action)
    controller.standardise(torch.zeros(4), torch.ones(4))
    torch.testing.assert_close(controller(observation), controller.act(observation))


@every_form
def test_it_is_differentiable_in_parameters_and_observations(form, options):
    controller = randomised(form(3, 2, (2,), **options))
    observation = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    names = [name for name, _ in controller.named_parameters()]

    def act(observation: Tensor, *parameters: Tensor) -> Tensor:
        return torch.func.functional_call(
            controller, dict(zip(names, parameters, strict=True)), (observation,)
        )

    assert torch.autograd.gradcheck(act, (observation, *controller.parameters()))


def test_the_linear_controller_is_affine():
    controller = randomised(LinearController(3, 2))
    controller.standardise(torch.zeros(3), torch.ones(3))
    observation = torch.randn(5, 3, dtype=torch.float64)
    expected = torch.stack(
        [controller.weight.mT @ row + controller.bias.squeeze(0) for row in observation.unbind()]
    )
    torch.testing.assert_close(controller(observation), expected)


def test_radial_basis_functions_are_normalised_bumps_round_their_centres():
    controller = randomised(RBFController(3, 2, centres=7, width=0.8))
    features = torch.randn(5, 3, dtype=torch.float64)
    distance = torch.cdist(features, controller.centre)
    bumps = torch.distributions.Normal(0, 0.8).log_prob(distance).exp()
    expected = bumps @ controller.weight / bumps.sum(-1, keepdim=True)
    torch.testing.assert_close(controller.act(features), expected)
    with torch.no_grad():
        controller.weight.fill_(3.0)
    torch.testing.assert_close(controller.act(features), torch.full((5, 2), 3.0, dtype=torch.float64))


def test_the_perceptron_is_torchs_own():
    controller = randomised(MLPController(3, 2, hidden=(8, 6)))
    layers: list[torch.nn.Module] = []
    for weight, bias in zip(controller.weights, controller.biases, strict=True):
        layer = torch.nn.Linear(*weight.shape, dtype=torch.float64)
        layer.load_state_dict({"weight": weight.mT, "bias": bias.squeeze(0)})
        layers += [layer, torch.nn.Tanh()]
    features = torch.randn(5, 3, dtype=torch.float64)
    torch.testing.assert_close(controller.act(features), torch.nn.Sequential(*layers[:-1])(features))


@pytest.mark.parametrize(("form", "options"), FORMS[1:], ids=["rbf", "mlp"])
def test_the_random_numbers_of_a_learner_do_not_depend_on_the_others(form, options):
    batch = form(6, 2, (4,), seed=5, **options)
    alone = form(6, 2, (1,), seed=5, first_learner=2, **options)
    for key, tensor in learner(alone, 0).items():
        assert torch.equal(tensor, learner(batch, 2)[key])
    drawn = "centre" if form is RBFController else "weights.0"
    others = [learner(batch, index)[drawn] for index in range(4)]
    others.append(learner(form(6, 2, (1,), seed=6, **options), 0)[drawn])
    assert len({tensor.sum().item() for tensor in others}) == 5


def test_more_than_one_batch_dimension_is_refused():
    with pytest.raises(ValueError, match=r"must be \(\) or \(learners,\), got \(2, 3\)"):
        LinearController(3, 1, (2, 3))
