"""The critic: one Gaussian process per learner behind scaling, clipping and TorchRL's keys."""

import copy

import pytest
import torch
from tensordict import TensorDict

from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential

LEARNERS, ENVS, STEPS = 2, 3, 20


def critic(*batch: int, bounded: bool = False, **keys: str) -> GPActionValue:
    """A critic of observations [*, 2] and actions [*, 1], these perhaps within ±2."""
    gp = SparseOnlineGP(SquaredExponential(3, batch_shape=batch), 200, 0.1)
    bounds = {"action_low": torch.tensor([-2.0]), "action_high": torch.tensor([2.0])} if bounded else {}
    return GPActionValue(gp, **keys, **bounds).requires_grad_(False)


def experience(*shape: int) -> TensorDict:
    """Observations and actions of all scales, and the returns of a smooth value around 50."""
    observation = torch.randn(*shape, 2) * torch.tensor([0.1, 30.0]) + torch.tensor([5.0, -10.0])
    action = 3 * torch.randn(*shape, 1)
    value = 50 + 7 * torch.sin(10 * observation[..., :1]) + action.clamp(-2, 2)
    data = {
        "observation": observation,
        "action": action,
        "value_target": value + 0.1 * torch.randn_like(value),
    }
    return TensorDict(data, shape)


def standardised(*batch: int, data: TensorDict, **options: bool) -> GPActionValue:
    made = critic(*batch, **options)
    made.standardise(data["observation"], data["action"], data["value_target"])
    return made


def test_it_writes_mean_and_variance_with_a_trailing_one_in_the_dtype_of_the_data():
    data = experience(LEARNERS, ENVS, STEPS)
    made = standardised(LEARNERS, data=data)
    made.update(data)
    assert made.in_keys == ["observation", "action"]
    assert made.out_keys == ["state_action_value", "state_action_value_variance"]
    out = made(data.select(*made.in_keys))
    mean, variance = made.value(data["observation"], data["action"])
    assert mean.dtype == torch.float64
    for key, expected in zip(made.out_keys, (mean, variance), strict=True):
        assert out[key].shape == (LEARNERS, ENVS, STEPS, 1)
        assert out[key].dtype == torch.float32
        torch.testing.assert_close(out[key].squeeze(-1), expected.float())


def test_observation_and_action_stand_where_one_says():
    data = experience(STEPS)
    named, renamed = critic(), critic(observation_key="pixels", action_key="torque")
    out = named(data.clone())
    data.rename_key_("observation", "pixels").rename_key_("action", "torque")
    assert torch.equal(renamed(data)["state_action_value"], out["state_action_value"])


def test_it_learns_values_of_any_scale_from_inputs_of_any_scale():
    data, unseen = experience(1, 400), experience(1, 100)
    made = standardised(1, data=data)
    made.update(data)
    predicted = made(unseen.clone())["state_action_value"]
    residual = (predicted - unseen["value_target"]).var() / unseen["value_target"].var()
    assert residual < 0.1


def test_scaling_makes_inputs_and_targets_standard():
    data = experience(LEARNERS, ENVS, STEPS)
    made = standardised(LEARNERS, data=data)
    inputs = made.inputs(data["observation"], data["action"])
    targets = made.standard_targets(data["value_target"])
    assert inputs.shape == (LEARNERS, ENVS * STEPS, 3)
    assert targets.shape == (LEARNERS, ENVS * STEPS)
    for scaled in (inputs, targets.unsqueeze(-1)):
        mean, std = scaled.mean(-2), scaled.std(-2, correction=0)
        torch.testing.assert_close(mean, torch.zeros_like(mean), rtol=0, atol=1e-10)
        torch.testing.assert_close(std, torch.ones_like(std), rtol=1e-10, atol=0)


def test_units_do_not_matter():
    data = experience(60)
    other = data.clone()
    other["observation"] = 1000 * data["observation"] - 3
    other["value_target"] = 0.01 * data["value_target"] + 8
    one, two = standardised(data=data.double()), standardised(data=other.double())
    for made, seen in ((one, data), (two, other)):
        made.update(seen.double())
    mean, variance = one.value(data["observation"].double(), data["action"].double())
    scaled = two.value(other["observation"].double(), other["action"].double())
    # the observations are in single precision
    torch.testing.assert_close(scaled.mean, 0.01 * mean + 8, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scaled.variance, 1e-4 * variance, rtol=1e-2, atol=1e-8)


def test_a_column_without_spread_keeps_its_scale():
    data = experience(STEPS)
    data["observation"][..., 0] = 4.0
    data["value_target"][:] = 9.0
    made = standardised(data=data)
    assert made.input_scale[0] == 1
    assert made.input_loc[0] == 4
    assert made.target_scale == 1
    made.update(data)
    mean, variance = made.value(data["observation"], data["action"])
    torch.testing.assert_close(mean, torch.full_like(mean, 9.0))
    assert (variance > 0).all()


def test_standardising_forgets_what_was_learned():
    data = experience(STEPS)
    made = standardised(data=data)
    made.update(data)
    made.standardise(data["observation"], data["action"], data["value_target"])
    assert made.gp.size == 0
    mean = made.mean_value(data["observation"], data["action"])
    torch.testing.assert_close(mean, data["value_target"].double().mean().expand_as(mean))


def test_the_mean_alone_is_the_mean():
    data = experience(LEARNERS, ENVS, STEPS)
    made = standardised(LEARNERS, data=data, bounded=True)
    made.update(data)
    pair = data["observation"], data["action"]
    torch.testing.assert_close(made.mean_value(*pair), made.value(*pair).mean, rtol=1e-9, atol=1e-9)


def test_actions_beyond_the_actuator_count_as_its_bounds():
    data = experience(100)
    made = standardised(data=data, bounded=True)
    made.update(data)
    state = data["observation"]
    for action in (2.0, -2.0):
        at_bound, beyond = (made.mean_value(state, torch.full((100, 1), f * action)) for f in (1, 5))
        assert torch.equal(at_bound, beyond)
    inside = made.mean_value(state, torch.ones(100, 1))
    assert not torch.equal(inside, made.mean_value(state, torch.full((100, 1), 2.0)))


def test_each_learner_has_a_critic_of_its_own():
    data = experience(LEARNERS, ENVS, STEPS).double()
    both = standardised(LEARNERS, data=data)
    both.update(data, stamp=4)
    together = both.value(data["observation"], data["action"])
    for learner in range(LEARNERS):
        single = standardised(data=data[learner])
        single.update(data[learner], stamp=4)
        alone = single.value(data[learner]["observation"], data[learner]["action"])
        for mine, theirs in zip(together, alone, strict=True):
            torch.testing.assert_close(mine[learner], theirs, rtol=1e-8, atol=1e-8)
        assert torch.equal(both.gp.stamps[learner], single.gp.stamps)


def test_the_stamp_and_the_targets_key_are_passed_on():
    data = experience(STEPS).rename_key_("value_target", "goal")
    made = critic()
    made.update(data, target_key="goal", stamp=7)
    size = int(made.gp.size)
    assert size > 0
    assert (made.gp.stamps[:size] == 7).all()


def test_bad_targets_teach_nothing():
    data = experience(STEPS)
    made = standardised(data=data)
    made.update(data)
    before = copy.deepcopy(made.state_dict())
    data["value_target"][3] = torch.nan
    with pytest.raises(ValueError, match="targets must be finite"):
        made.update(data)
    assert all(torch.equal(before[key], tensor) for key, tensor in made.state_dict().items())


def test_a_saved_critic_gives_the_same_values():
    data = experience(LEARNERS, ENVS, STEPS)
    made, twin = standardised(LEARNERS, data=data, bounded=True), critic(LEARNERS, bounded=True)
    made.update(data)
    twin.load_state_dict(made.state_dict())
    pair = data["observation"], data["action"]
    assert all(map(torch.equal, twin.value(*pair), made.value(*pair)))


def test_the_value_is_differentiable_in_the_action():
    data = experience(60).double()
    made = standardised(data=data)
    made.update(data)
    state, action = data["observation"][:3], data["action"][:3].requires_grad_()
    assert torch.autograd.gradcheck(lambda action: made.mean_value(state, action), action)


def test_basis_vectors_are_points_of_the_data_in_their_own_units():
    data = experience(LEARNERS, ENVS, STEPS)
    made = standardised(LEARNERS, data=data)
    made.update(data)
    seen = torch.cat([data["observation"], data["action"]], -1).flatten(1, 2).double()
    for learner, points in enumerate(seen):
        basis = made.basis_points(learner)
        assert len(basis) == int(made.gp.size[learner])
        assert torch.cdist(basis, points).amin(1).max() < 1e-4
