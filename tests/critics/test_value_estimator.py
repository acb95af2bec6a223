"""The value estimator: every weight against its definition, and TorchRL's own losses with it."""

import itertools
from typing import get_args

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import A2CLoss, ClipPPOLoss, ReinforceLoss
from torchrl.objectives.value import GAE

from torch_gprl.critics import ESTIMATORS, EstimatorName, GPActionValue, GPStateValue, GPValueEstimator
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.objectives import PolicyGradientLoss
from torch_gprl.policies import GaussianPolicy, MLPController, gaussian_policy

LEARNERS, ENVS, STEPS = 2, 3, 12
DISCOUNT = 0.875  # exact in single precision, to which TorchRL's GAE rounds it


def policy(*batch: int) -> GaussianPolicy:
    controller = MLPController(2, 1, batch, hidden=(4,)).double()
    for parameter in controller.parameters():
        torch.nn.init.normal_(parameter)
    return gaussian_policy(controller, Bounded(-2.0, 2.0, shape=(1,), dtype=torch.float64), std=0.4)


def rollout(actor: GaussianPolicy, *shape: int) -> TensorDict:
    """Steps with random ends of both kinds, rewards that depend on state and action."""
    state = torch.randn(*shape[:-1], shape[-1] + 1, 2, dtype=torch.float64)
    data = TensorDict({"observation": state[..., :-1, :]}, shape)
    with torch.no_grad():
        data = actor(data)
    terminated, truncated = (torch.rand(*shape, 1) < 0.15 for _ in range(2))
    data["next"] = TensorDict(
        {
            "observation": state[..., 1:, :],
            "reward": data["observation"][..., :1] + data["action"].cos(),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        },
        shape,
    )
    return data


def critic(data: TensorDict, actor: GaussianPolicy, *batch: int) -> GPActionValue:
    gp = SparseOnlineGP(SquaredExponential(3, 1.5, batch_shape=batch), 60, 0.05)
    bounds = {"action_low": torch.tensor([-2.0]), "action_high": torch.tensor([2.0])}
    made = GPActionValue(gp, **bounds).requires_grad_(False)
    made.standardise(data["observation"], data["action"], data["next", "reward"])
    made.update_differences(data, actor, DISCOUNT)
    return made


@pytest.fixture
def scene() -> tuple[TensorDict, GaussianPolicy, GPActionValue]:
    actor = policy(LEARNERS)
    data = rollout(actor, LEARNERS, ENVS, STEPS)
    return data, actor, critic(data, actor, LEARNERS)


def estimator(scene, name: EstimatorName, **options) -> TensorDict:
    data, actor, made = scene
    return GPValueEstimator(made, actor, DISCOUNT, name, **options)(data.clone())


def values(scene) -> dict[str, Tensor]:
    """Q(s, a), V(s), V(s'), one call each."""
    data, actor, made = scene
    with torch.no_grad():
        at, following = (actor.head.parameters_at(part["observation"]) for part in (data, data["next"]))
        return {
            "taken": made.value(data["observation"], data["action"]).mean,
            "value": made.state_value(data["observation"], *at).mean,
            "next": made.state_value(data["next", "observation"], *following).mean,
        }


def by_loop(scene, horizon: int, trace: float, seen: dict[str, Tensor], ahead: str) -> Tensor:
    """Σ_i (γλ)^i of rewards up to the horizon and the value beyond, step by step."""
    data = scene[0]
    reward, done, terminated = (data["next", key].squeeze(-1) for key in ("reward", "done", "terminated"))
    out = torch.zeros_like(reward)
    for place in itertools.product(range(LEARNERS), range(ENVS), range(STEPS)):
        *row, start = place
        for i in range(horizon):
            here = (*row, start + i)
            final = bool(done[here]) or start + i == STEPS - 1
            if trace < 1:  # differences
                beyond = 0.0 if terminated[here] else seen["next"][here]
                out[place] += (DISCOUNT * trace) ** i * (
                    reward[here] + DISCOUNT * beyond - seen["value"][here]
                )
            else:
                out[place] += DISCOUNT**i * reward[here]
            if final or i == horizon - 1:
                follows = ahead == "taken" and not final
                beyond = seen["taken"][(*row, start + i + 1)] if follows else seen["next"][here]
                if trace == 1 and not terminated[here]:
                    out[place] += DISCOUNT ** (i + 1) * beyond
                break
    return out


def test_every_name_has_a_rule():
    assert set(ESTIMATORS) == set(get_args(EstimatorName))


@pytest.mark.parametrize("horizon", [1, 3, STEPS])
@pytest.mark.parametrize(("name", "ahead", "less"), [("k-step", "taken", 0), ("k-step-baseline", "next", 1)])
def test_k_step_weights_are_rewards_then_the_critics_value(scene, name, ahead, less, horizon):
    seen = values(scene)
    expected = by_loop(scene, horizon, 1.0, seen, ahead) - less * seen["value"]
    found = estimator(scene, name, horizon=horizon)
    torch.testing.assert_close(found["advantage"].squeeze(-1), expected, rtol=1e-9, atol=1e-9)
    target = by_loop(scene, horizon, 1.0, seen, "next")
    torch.testing.assert_close(found["value_target"].squeeze(-1), target, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found["state_value"].squeeze(-1), seen["value"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "less"), [("k-step", 0), ("k-step-baseline", 1)])
def test_horizon_0_asks_the_critic_alone(scene, name, less):
    seen = values(scene)
    found = estimator(scene, name, horizon=0)["advantage"].squeeze(-1)
    torch.testing.assert_close(found, seen["taken"] - less * seen["value"], rtol=1e-9, atol=1e-9)


def test_a_horizon_past_the_end_is_the_return_bit_for_bit(scene):
    long, longer = (estimator(scene, "k-step-baseline", horizon=h)["advantage"] for h in (STEPS, 10**6))
    assert torch.equal(long, longer)
    assert torch.equal(long, estimator(scene, "value-baseline")["advantage"])


def test_generalised_weights_are_sums_of_discounted_differences(scene):
    expected = by_loop(scene, STEPS, 0.7, values(scene), "next")
    found = estimator(scene, "generalised", trace=0.7)["advantage"].squeeze(-1)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_generalised_weights_agree_with_torchrl(scene):
    data, actor, made = scene
    single = data[0], policy_of(actor, 0), critic_of(made, 0)
    found = estimator(single, "generalised", trace=0.75)["advantage"]
    gae = GAE(gamma=DISCOUNT, lmbda=0.75, value_network=GPStateValue(single[2], single[1]))
    torch.testing.assert_close(gae(single[0].clone())["advantage"], found, rtol=1e-9, atol=1e-9)


def policy_of(actor: GaussianPolicy, learner: int) -> GaussianPolicy:
    alone = policy()
    alone.load_state_dict({k: v[learner] if v.ndim > 1 else v for k, v in actor.state_dict().items()})
    return alone


def critic_of(made: GPActionValue, learner: int) -> GPActionValue:
    gp = SparseOnlineGP(SquaredExponential(3, 1.5), 60, 0.05)
    alone = GPActionValue(gp, action_low=made.action_low, action_high=made.action_high).requires_grad_(False)
    shared = ("action_low", "action_high", "gp.clock")
    state = {k: v if k in shared else v[learner] for k, v in made.state_dict().items()}
    alone.load_state_dict(state)
    return alone


def test_returns_weigh_by_the_first_step_of_each_episode(scene):
    done = scene[0]["next", "done"].squeeze(-1)
    to_go, full = (estimator(scene, name)["advantage"].squeeze(-1) for name in ("reward-to-go", "return"))
    for row in itertools.product(range(LEARNERS), range(ENVS)):
        first = 0
        for t in range(STEPS):
            assert full[row][t] == to_go[row][first]
            first = t + 1 if done[row][t] else first


@pytest.mark.parametrize("name", ["mean-baseline", "optimal-baseline"])
def test_constant_baselines_do_not_see_their_own_environment(scene, name):
    data, actor, made = scene
    baseline = [
        estimator((part, actor, made), "reward-to-go")["advantage"]
        - estimator((part, actor, made), name)["advantage"]
        for part in (data, changed(data))
    ]
    torch.testing.assert_close(baseline[0][:, 0], baseline[1][:, 0], rtol=0, atol=1e-9)
    assert ((baseline[0] - baseline[1])[:, 1].abs() > 1).all()
    spread = baseline[0].std(2)
    torch.testing.assert_close(spread, torch.zeros_like(spread), rtol=0, atol=1e-12)


def changed(data: TensorDict) -> TensorDict:
    """The same rollout with other rewards in the first environment."""
    other = data.clone()
    other["next", "reward"][:, 0] += 100 * torch.rand(LEARNERS, STEPS, 1, dtype=torch.float64)
    return other


def test_constant_baselines_need_other_environments(scene):
    data, actor, made = scene
    with pytest.raises(ValueError, match="needs at least 2 of them"):
        GPValueEstimator(made, actor, DISCOUNT, "mean-baseline")(data[:, :1])


def test_a_control_variate_is_what_the_critic_did_not_expect(scene):
    to_go = estimator(scene, "reward-to-go")["advantage"].squeeze(-1)
    seen = values(scene)
    for name, expected in (
        ("control-variate", to_go - seen["taken"]),
        ("advantage", seen["taken"] - seen["value"]),
        ("all-action", torch.zeros_like(to_go)),
    ):
        torch.testing.assert_close(
            estimator(scene, name)["advantage"].squeeze(-1), expected, rtol=1e-9, atol=1e-9
        )


def test_keys_can_be_renamed(scene):
    data, actor, made = scene
    renamed = GPValueEstimator(made, actor, DISCOUNT)
    renamed.set_keys(advantage="weight", value_target="goal", reward="gain")
    other = data.clone()
    other.rename_key_(("next", "reward"), ("next", "gain"))
    out = renamed(other)
    plain = GPValueEstimator(made, actor, DISCOUNT)(data.clone())
    for mine, theirs in (("weight", "advantage"), ("goal", "value_target")):
        assert torch.equal(out[mine], plain[theirs])


# ---------------------------------------------------------------- TorchRL's losses

LOSSES = {
    "reinforce": lambda actor, value: ReinforceLoss(actor, critic_network=value),
    "a2c": lambda actor, value: A2CLoss(actor, critic_network=value, critic_coeff=None),
    "ppo": lambda actor, value: ClipPPOLoss(actor, critic_network=value, critic_coeff=None),
}


@pytest.mark.parametrize("name", LOSSES)
def test_torchrls_losses_take_their_advantage_from_it(name):
    actor = policy()
    data = rollout(actor, ENVS, STEPS)
    made = critic(data, actor)
    value_estimator = GPValueEstimator(made, actor, DISCOUNT, "generalised")
    loss = LOSSES[name](actor, GPStateValue(made, actor))
    loss.make_value_estimator(value_estimator)
    out = loss(data.clone())
    key = "loss_actor" if name == "reinforce" else "loss_objective"
    out[key].backward()
    found = [p.grad.clone() for p in loss.parameters() if p.grad is not None]
    assert len(found) == len(list(actor.parameters()))

    mine = policy_copy(actor)
    PolicyGradientLoss(mine, learners=False)(value_estimator(data.clone()))["loss_objective"].backward()
    for gradient, expected in zip(found, (p.grad for p in mine.parameters()), strict=True):
        # at the first step every objective has the gradient of the plain one
        torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-8)


def policy_copy(actor: GaussianPolicy) -> GaussianPolicy:
    other = policy()
    other.load_state_dict(actor.state_dict())
    return other


def test_the_critic_is_neither_trained_nor_saved_with_the_estimator():
    actor = policy()
    data = rollout(actor, ENVS, STEPS)
    made = GPValueEstimator(critic(data, actor), actor, DISCOUNT)
    assert not list(made.parameters())
    assert not made.state_dict()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "magic"}, "estimator must be one of return, .*, got 'magic'"),
        ({"horizon": -1}, "at least 0"),
    ],
)
def test_what_does_not_exist_is_refused(scene, options, message, monkeypatch):
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        GPValueEstimator(scene[2], scene[1], DISCOUNT, **options)
