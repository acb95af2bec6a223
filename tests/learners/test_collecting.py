"""Collections: rollouts go on exactly where a saved one stood, and broken environments are named."""

import io

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ObservationNorm, TransformedEnv

import envs
from torch_gprl.learners.collecting import Collection

STEPS = 10


def proportional() -> TensorDictModule:
    """A policy without random numbers."""
    return TensorDictModule(lambda seen: -seen[..., :1], in_keys=["observation"], out_keys=["action"])


def pendulums(seed: int = 0) -> EnvBase:
    return envs.make("pendulum-swingup", learners=2, num_envs=3, horizon=15, seed=seed, threads=1)


def saved_and_loaded(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def assert_same(one, two) -> None:
    assert set(one.keys(True, True)) == set(two.keys(True, True))
    assert all(torch.equal(one[key], two[key]) for key in one.keys(True, True))


def test_rollouts_follow_each_other():
    collection = Collection(pendulums(), proportional(), STEPS)
    first, second = collection.rollout(), collection.rollout()
    assert first.shape == second.shape == (2, 3, STEPS)
    assert torch.equal(first["next", "observation"][..., -1, :], second["observation"][..., 0, :])
    assert second["step_count"][..., 0, 0].unique().tolist() == [STEPS]
    assert second["step_count"][..., -1, 0].unique().tolist() == [4]  # the episodes of 15 steps have ended
    reward, total = second["next", "reward"], second["next", "episode_reward"]
    torch.testing.assert_close(total[..., 5:, :], reward[..., 5:, :].cumsum(-2))


@pytest.mark.parametrize("rollouts", [1, 2])
def test_a_loaded_collection_goes_on_bit_for_bit(rollouts):
    collection = Collection(pendulums(), proportional(), STEPS)
    for _ in range(rollouts):
        collection.rollout()
    other = Collection(pendulums(seed=5), proportional(), STEPS)
    other.load_state_dict(saved_and_loaded(collection.state_dict()))
    for _ in range(3):
        assert_same(collection.rollout(), other.rollout())


def test_a_collection_goes_back_to_what_it_loads():
    collection = Collection(pendulums(), proportional(), STEPS)
    collection.rollout()
    saved = saved_and_loaded(collection.state_dict())
    after = collection.rollout()
    collection.load_state_dict(saved)
    assert_same(collection.rollout(), after)


def test_the_environments_own_transforms_are_saved_too():
    def scaled(loc: float) -> EnvBase:
        return TransformedEnv(pendulums(), ObservationNorm(loc=loc, scale=2.0, in_keys=["observation"]))

    collection = Collection(scaled(0.5), proportional(), STEPS)
    collection.rollout()
    other = Collection(scaled(7.0), proportional(), STEPS)
    other.load_state_dict(saved_and_loaded(collection.state_dict()))
    assert_same(collection.rollout(), other.rollout())


def test_nothing_was_carried_before_the_first_rollout():
    collection = Collection(pendulums(), proportional(), STEPS)
    assert collection.state_dict() == {}
    for state in ({}, {"workers": [{"simulation": {}}]}):  # the second is of a collection by processes
        collection.load_state_dict(state)
        assert collection.rollout()["step_count"][..., 0, 0].eq(0).all()


class Broken(EnvBase):
    """An environment without a saved state, whose fourth step gives a number that is none."""

    def __init__(self, key: str, bad: float) -> None:
        super().__init__(batch_size=(2, 3))
        self.key, self.bad, self.count = key, bad, 0
        self.observation_spec = Composite(observation=Unbounded((2, 3, 1)), shape=(2, 3))
        self.action_spec = Bounded(-1, 1, (2, 3, 1))
        self.reward_spec = Unbounded((2, 3, 1))

    def _reset(self, tensordict=None, **kwargs) -> TensorDict:
        return TensorDict({"observation": torch.zeros(2, 3, 1)}, (2, 3))

    def _step(self, tensordict) -> TensorDict:
        out = {name: torch.zeros(2, 3, 1) for name in ("observation", "reward")}
        out["done"] = torch.zeros(2, 3, 1, dtype=torch.bool)
        self.count += 1
        if self.count >= 4:
            out[self.key][1, 2] = self.bad
        return TensorDict(out, (2, 3))

    def _set_seed(self, seed) -> None:
        pass


@pytest.mark.parametrize("key", ["observation", "reward"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_named(key, bad):
    collection = Collection(Broken(key, bad), proportional(), 3)
    collection.rollout()
    message = f"a {key} that is not finite: entry 0 of learner 1, environment 2 is {bad}"
    with pytest.raises(FloatingPointError, match=message):
        collection.rollout()


def test_an_environment_that_saves_nothing_starts_anew():
    collection = Collection(Broken("reward", 0.0), proportional(), 3)
    collection.rollout()
    collection.load_state_dict(saved_and_loaded(collection.state_dict()))
    assert collection.rollout()["step_count"][..., 0, 0].eq(0).all()
