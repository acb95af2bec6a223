"""The numbers behind the picture of a value function: whose they are, and where they lie."""

from types import SimpleNamespace

import pytest
import torch
from tensordict.nn import TensorDictModule

from torch_gprl.gp import Posterior
from torch_gprl.runs import value_on_plane


def test_the_value_surface_shows_the_chosen_learner_where_it_belongs():
    """A critic whose value is known: learner 1's is x + 10 y + 100 action, with the action 2 x."""
    rate = torch.tensor([0.0, 2.0])[:, None, None]
    policy = TensorDictModule(lambda o: rate * o[..., :1], in_keys=["observation"], out_keys=["action"])

    def value(observation: torch.Tensor, action: torch.Tensor) -> Posterior:
        mean = observation[..., 0] + 10 * observation[..., 1] + 100 * action[..., 0]
        return Posterior(mean, observation[..., 0].square())

    def basis_points(learner: int) -> torch.Tensor:
        return [torch.full((1, 3), 9.0), torch.tensor([[1.25, -2.75, 7.0]] * 3)][learner]

    critic = SimpleNamespace(basis_points=basis_points, value=value)
    plane = SimpleNamespace(
        labels=("x", "y"),
        low=(-1.0, -2.0),
        high=(1.0, 2.0),
        to_observation=lambda p: p,
        from_observation=lambda o: o,
    )
    surface = value_on_plane(critic, policy, plane, learner=1, learners=2)

    x, y = torch.meshgrid(torch.tensor(surface.x), torch.tensor(surface.y), indexing="xy")
    assert surface.mean == pytest.approx((201 * x + 10 * y).numpy(), abs=1e-4)
    assert surface.stddev == pytest.approx(x.abs().numpy(), abs=1e-5)
    assert surface.basis.tolist() == [[1.25, -2.75]] * 3
    assert (surface.x[[0, -1]].tolist(), surface.y[[0, -1]].tolist()) == ([-1, 1], [-2, 2])
