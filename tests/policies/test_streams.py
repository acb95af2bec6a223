"""Random streams: a learner's numbers are its own, and continue where they stood."""

import pytest
import torch
from torch import Tensor

from torch_gprl.policies.streams import NoiseStream, learner_generators, stacked_normal


def draws(stream: NoiseStream, count: int, like: Tensor) -> Tensor:
    """[learners, count, ...]."""
    return torch.stack([stream.draw(like) for _ in range(count)], 1)


def test_noise_has_the_shape_and_the_dtype_of_its_model():
    for dtype in (torch.float32, torch.float64):
        noise = NoiseStream(0, range(3)).draw(torch.zeros(3, 5, 2, dtype=dtype))
        assert noise.shape == (3, 5, 2)
        assert noise.dtype == dtype


def test_noise_is_standard_normal_and_white():
    noise = draws(NoiseStream(0, range(4)), 5_000, torch.zeros(4, 5, 2, dtype=torch.float64))
    count = noise.numel()
    # six standard errors each: together fewer than one failure in 10⁷ seeds
    assert abs(noise.mean()) < 6 / count**0.5
    assert abs(noise.square().mean() - 1) < 6 * (2 / count) ** 0.5
    assert abs(noise.pow(4).mean() - 3) < 6 * (96 / count) ** 0.5
    for dim in range(4):  # neighbours: learners, steps, environments, entries
        product = noise.narrow(dim, 1, noise.shape[dim] - 1) * noise.narrow(dim, 0, noise.shape[dim] - 1)
        assert abs(product.mean()) < 6 / product.numel() ** 0.5


def test_what_a_learner_draws_does_not_depend_on_the_others():
    many = draws(NoiseStream(3, range(5)), 70, torch.zeros(5, 4, 2))
    for index in (0, 4):
        alone = draws(NoiseStream(3, [index]), 70, torch.zeros(1, 4, 2))
        assert torch.equal(alone[0], many[index])


def test_seeds_and_learners_have_streams_of_their_own():
    generators = [g for seed in range(20) for g in learner_generators(seed, range(20), "weights")]
    assert len(stacked_normal(generators, (1,)).unique()) == 400


@pytest.mark.parametrize("before", [0, 5, NoiseStream.BLOCK, NoiseStream.BLOCK + 3])
def test_a_restored_stream_continues_where_it_stood(before):
    like = torch.zeros(2, 3, 1, dtype=torch.float64)
    stream, restored = NoiseStream(1, range(2)), NoiseStream(9, range(2))
    draws(restored, 3, like)
    for _ in range(before):
        stream.draw(like)
    state = stream.state()
    expected = draws(stream, 2 * NoiseStream.BLOCK, like)
    restored.restore(state)
    assert torch.equal(draws(restored, 2 * NoiseStream.BLOCK, like), expected)


def test_a_stream_restored_under_another_dtype_follows_its_model():
    stream, restored = NoiseStream(1, range(2)), NoiseStream(1, range(2))
    stream.draw(torch.zeros(2, 3, 1))
    restored.restore(stream.state())
    noise = restored.draw(torch.zeros(2, 3, 1, dtype=torch.float64))
    assert noise.dtype == torch.float64
    assert torch.equal(noise, stream.draw(torch.zeros(2, 3, 1)).double())


def test_another_number_of_environments_starts_a_new_block():
    stream = NoiseStream(1, range(2))
    stream.draw(torch.zeros(2, 3, 1))
    assert stream.draw(torch.zeros(2, 4, 1)).shape == (2, 4, 1)


def test_the_noise_of_a_policy_is_not_that_of_its_weights():
    weights = stacked_normal(learner_generators(0, [1], "weights"), (64, 3, 2))
    noise = draws(NoiseStream(0, [1]), 64, torch.zeros(1, 3, 2))
    assert not torch.isin(noise, weights).any()
