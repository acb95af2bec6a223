"""Critics and policies on experience of any shape: batches, dtypes and options drawn at random."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jaxtyping
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_gprl.critics import GPActionValue
from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential
from torch_gprl.policies import ConfidenceNoise, GibbsPolicy, MLPController, NoiseStream, ScaledController

EXAMPLES = settings(max_examples=8, deadline=None, derandomize=True)
POLICIES: dict[str, Callable] = {
    "confidence": lambda greedy, critic, noise: ConfidenceNoise(greedy, critic, noise=noise),
    "gibbs": lambda greedy, critic, noise: GibbsPolicy(greedy, critic, noise=noise),
}


class Scene(NamedTuple):
    """A critic over states and actions, and experience [learners, ...] for it."""

    critic: GPActionValue
    data: TensorDict

    @property
    def greedy(self) -> ScaledController:
        states, actions = (self.data[key].shape[-1] for key in ("observation", "action"))
        controller = MLPController(states, actions, self.critic.gp.batch_shape, hidden=(3,), seed=0)
        low, high = self.critic.action_low, self.critic.action_high
        return ScaledController(controller.to(self.data["observation"].dtype), low, high)

    @property
    def noise(self) -> NoiseStream:
        return NoiseStream(0, range(self.critic.gp.batch_shape[0]))


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    learners, states = draw(st.integers(1, 3)), draw(st.sampled_from([1, 3, 100]))
    actions, dtype = draw(st.integers(1, 2)), draw(st.sampled_from([torch.float32, torch.float64]))
    shape = (learners, *draw(st.lists(st.integers(1, 4), min_size=1, max_size=3)))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))

    def columns(count: int) -> torch.Tensor:
        return torch.randn(*shape, count, generator=generator, dtype=dtype)

    flat = draw(st.booleans())
    target = torch.ones(*shape, 1, dtype=dtype) if flat else columns(1)
    parts = {"observation": columns(states), "action": columns(actions), "value_target": target}
    kernel = SquaredExponential(states + actions, batch_shape=(learners,))
    box = {"action_low": torch.full((actions,), -1.0), "action_high": torch.full((actions,), 2.0)}
    critic = GPActionValue(SparseOnlineGP(kernel, draw(st.integers(1, 8)), 0.1), **box)
    return Scene(critic.requires_grad_(False), TensorDict(parts, shape))


@pytest.fixture(autouse=True, scope="module")
def _as_users_run_it() -> Iterator[None]:
    """Without the hook that checks shapes, so that the library's own refusals are what is tested."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


def taught(scene: Scene) -> GPActionValue:
    scene.critic.standardise(*(scene.data[key] for key in ("observation", "action", "value_target")))
    scene.critic.update(scene.data)
    return scene.critic


@EXAMPLES
@given(scenes())
def test_a_critic_speaks_in_the_shape_and_dtype_it_is_asked_in(scene: Scene):
    critic, data = taught(scene), scene.data
    out = critic(data.clone())
    for key in critic.out_keys:
        assert out[key].shape == (*data.batch_size, 1)
        assert out[key].dtype == data["observation"].dtype
        assert out[key].isfinite().all()
    assert (out["state_action_value_variance"] >= 0).all()
    assert (critic.gp.observations == data[0].numel()).all()


@EXAMPLES
@given(scenes(), st.sampled_from(["observation", "action", "value_target"]))
def test_a_critic_refuses_numbers_that_are_none(scene: Scene, key: str):
    critic = taught(scene)
    before = {name: tensor.clone() for name, tensor in critic.state_dict().items()}
    spoiled = scene.data.clone()
    spoiled[key].view(-1)[0] = torch.nan
    with pytest.raises(ValueError, match="must be finite"):
        critic.update(spoiled)
    assert all(torch.equal(before[name], tensor) for name, tensor in critic.state_dict().items())


@pytest.mark.parametrize("name", POLICIES)
@EXAMPLES
@given(scene=scenes())
def test_a_policy_acts_in_the_shape_it_is_asked_in(name: str, scene: Scene):
    policy = POLICIES[name](scene.greedy, taught(scene), scene.noise)
    states = scene.data.select("observation")
    out = policy(states.clone())
    assert out["action"].shape == scene.data["action"].shape
    assert out["action"].dtype == states["observation"].dtype
    assert out["action"].isfinite().all()
    assert out["action_log_prob"].shape == states.batch_size
    assert out["action_log_prob"].isfinite().all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        settled = [policy(states.clone())["action"] for _ in range(2)]
    assert torch.equal(*settled)
    torch.testing.assert_close(settled[0], scene.greedy(states["observation"]))
