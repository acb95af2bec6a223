"""What a learner of action values does to explore, by name: what holds for every scheme."""

import copy
import pickle
from typing import get_args

import jaxtyping
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from tests.policies.gibbs_cases import taught_critic
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.policies import Behaviour, BehaviourPolicy, NoiseStream, Scheme

LEARNERS, ENVS = 2, 3
SCHEMES = get_args(Scheme)


def policy(
    scheme: str, learners: int = LEARNERS, seed: int = 4, first: int = 0, **options
) -> BehaviourPolicy:
    critic = taught_critic(1, learners)
    assert critic.action_low is not None
    assert critic.action_high is not None
    box = ActionMaximiser(critic, critic.action_low, critic.action_high, 33)
    acting = BehaviourPolicy(
        Behaviour(exploration=scheme, **options), box, seed, range(first, first + learners)
    )
    acting.uniform = False
    return acting


def states(step: int = 0, learners: int = LEARNERS, envs: int = ENVS) -> TensorDict:
    observation = torch.linspace(-1, 1, 2 * envs).reshape(1, envs, 2).expand(learners, -1, -1)
    count = torch.full((learners, envs, 1), step)
    return TensorDict({"observation": observation, "step_count": count}, (learners, envs))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_is_uniform_in_the_box_until_it_is_told_otherwise(scheme):
    acting = policy(scheme)
    acting.uniform = True
    data = acting(states(envs=2000))
    share = (data["action"].flatten() + 1) / 3
    grid = torch.arange(1, 4001) / 4000
    assert (share.sort().values - grid).abs().max() < 2.23 / 4000**0.5  # Kolmogorov's 99.99 % bound
    assert set(data.keys()) == {"observation", "step_count", "action"}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_strays_within_the_box_and_is_greedy_when_asked(scheme):
    acting = policy(scheme)
    strayed = acting(states())["action"]
    assert ((strayed >= -1) & (strayed <= 2)).all()
    greedy = acting.maximiser(states()["observation"]).action.float()
    assert (strayed - greedy).abs().max() > 1e-3
    for uniform in (False, True):
        acting.uniform = uniform
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            found = acting(states().exclude("step_count"))["action"]
        torch.testing.assert_close(found, greedy)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_what_a_learner_does_does_not_depend_on_the_others(scheme):
    together, alone = policy(scheme), policy(scheme, learners=1, first=1)
    one, other = alone.maximiser.critic, together.maximiser.critic
    for name, mine in one.named_buffers():
        theirs = other.get_buffer(name)
        mine.copy_(theirs if theirs.shape == mine.shape else theirs[1:2])
    for step in range(3):
        expected = together(states(step))["action"][1:2]
        torch.testing.assert_close(alone(states(step, 1))["action"], expected)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_continues_where_it_was_saved(scheme):
    one, two = policy(scheme), policy(scheme, seed=9)
    for step in range(3):
        one(states(step))
    two.restore_exploration(one.exploration_state())
    for step in range(3, 8):
        assert torch.equal(one(states(step))["action"], two(states(step))["action"])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_copies_for_other_processes_ask_a_critic_of_their_own(scheme):
    original = policy(scheme)
    for other in (copy.deepcopy(original), pickle.loads(pickle.dumps(original))):
        before = other(states(0))["action"]
        assert torch.equal(before, policy(scheme)(states(0))["action"])
    original.maximiser.critic.gp.reset()
    assert other.maximiser.critic.gp.size.all()
    other.noise = NoiseStream(77, range(LEARNERS))
    assert other.noise.state()["generators"].ne(original.noise.state()["generators"]).any()


def test_the_reach_of_guidance_may_follow_the_critics_variance():
    near, far = states(), states()
    far["observation"] = far["observation"] + 50
    guided = policy("gibbs", gibbs_width=None, noise_scale=0.5, most_std=0.6)
    widths = [guided.policy(data)["gibbs", "width"] for data in (near, far)]
    assert (widths[0] < widths[1]).all()
    torch.testing.assert_close(widths[1], torch.full_like(widths[1], 0.6 * 1.5))  # halves of a range of 3


def test_noise_and_guidance_change_as_learning_goes_on():
    gaussian = policy("gaussian", std=0.5, final_std=0.1)
    spreads = []
    for share in (0.0, 1.0):
        gaussian.anneal(share)
        data = gaussian(states(envs=3000))
        greedy = gaussian.maximiser(data["observation"]).action
        inside = (data["action"] > -1) & (data["action"] < 2)
        spreads.append((data["action"] - greedy)[inside].std().item())
    assert spreads[1] < 0.5 * spreads[0]
    gibbs = policy("gibbs")
    gibbs.anneal(1.0)
    assert gibbs.policy.head.inverse_temperature == gibbs.behaviour.gibbs.final_inverse_temperature


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exploration": "random"}, "exploration must be one of gaussian, confidence"),
        ({"std": -0.1}, "std must be at least 0"),
        ({"epsilon": 1.5}, "epsilon must lie between 0 and 1"),
        ({"least_std": 2.0}, "floor ≤ ceiling"),
        ({"inverse_temperature": 0.0}, "inverse temperatures must be positive"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it, without the hook
    with pytest.raises(ValueError, match=message):
        Behaviour(**options)
