"""Whatever the data are, the process stays a process: shapes, dtypes, masks and options drawn at random."""

import copy
from collections.abc import Iterator
from typing import Any, NamedTuple

import jaxtyping
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import Matern, SquaredExponential

EXAMPLES = settings(
    max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
KERNELS = {"squared exponential": SquaredExponential, "matern": Matern}
NO_POINTS = 0


class Case(NamedTuple):
    """A process and blocks of data for it: inputs, targets, mask."""

    gp: SparseOnlineGP
    blocks: list[tuple[Tensor, Tensor, Tensor | None]]


@st.composite
def processes(draw: st.DrawFn) -> SparseOnlineGP:
    batch = draw(st.sampled_from([(), (1,), (3,), (2, 2)]))
    kernel = KERNELS[draw(st.sampled_from(sorted(KERNELS)))](draw(st.sampled_from([1, 2, 100])))
    options: dict[str, Any] = {
        "budget": draw(st.integers(1, 8)),
        "noise_variance": draw(st.sampled_from([1e-4, 0.1, 10.0])),
        "novelty_threshold": draw(st.sampled_from([0.0, 0.3, 3.0])),
        "projection": draw(st.sampled_from(["moment", "dtc"])),
        "order": draw(st.sampled_from(["novelty", "arrival"])),
        "overshoot": draw(st.sampled_from([None, 1, 5])),
    }
    return SparseOnlineGP(kernel, batch_shape=batch, **options)


@st.composite
def tensors(draw: st.DrawFn, shape: tuple[int, ...]) -> Tensor:
    """Numbers of one of the kinds that experience brings: spread out, all alike, repeated, far away."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    values = torch.randn(shape, generator=generator, dtype=dtype)
    kind = draw(st.sampled_from(["spread", "constant", "repeated", "large", "tiny"]))
    if kind == "constant":
        return torch.full_like(values, 1.5)
    if kind == "repeated":
        return values.round()
    return values * {"spread": 1.0, "large": 1e6, "tiny": 1e-6}[kind]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    gp, blocks = draw(processes()), []
    for _ in range(draw(st.integers(1, 3))):
        shape = (*gp.batch_shape, draw(st.integers(NO_POINTS, 12)))
        inputs = draw(tensors((*shape, gp.kernel.input_dim)))
        seed = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))
        mask = torch.rand(shape, generator=seed) < draw(st.sampled_from([0.0, 0.5, 1.0]))
        blocks.append((inputs, draw(tensors(shape)), draw(st.sampled_from([None, mask]))))
    return Case(gp, blocks)


@pytest.fixture(autouse=True, scope="module")
def _as_users_run_it() -> Iterator[None]:
    """Without the hook that checks shapes, so that the library's own refusals are what is tested."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


def same_state(one: SparseOnlineGP, other: SparseOnlineGP) -> bool:
    mine, theirs = one.state_dict(), other.state_dict()
    return all(torch.equal(mine[name], theirs[name]) for name in mine)


@EXAMPLES
@given(cases())
def test_a_process_stays_one(case: Case):
    gp, seen = case.gp, torch.zeros(case.gp.batch_shape)
    for stamp, (inputs, targets, mask) in enumerate(case.blocks):
        gp.update(inputs, targets, stamp=stamp, mask=mask)
        seen = seen + (inputs.shape[-2] if mask is None else mask.sum(-1))
        posterior, prior = gp.posterior(inputs), gp.kernel.diag(inputs.double())
        assert posterior.mean.isfinite().all()
        assert (posterior.variance > -1e-8).all()
        assert (posterior.variance < prior + 1e-8).all()
    assert torch.equal(gp.observations, seen.long())
    assert (gp.size <= gp.capacity).all()
    assert all(tensor.isfinite().all() for tensor in gp.state_dict().values())


@EXAMPLES
@given(cases())
def test_what_the_mask_leaves_out_may_be_anything(case: Case):
    other = copy.deepcopy(case.gp)
    for inputs, targets, mask in case.blocks:
        case.gp.update(inputs, targets, mask=mask)
        if mask is not None:
            inputs = inputs.where(mask.unsqueeze(-1), torch.nan)
            targets = targets.where(mask, torch.inf)
        other.update(inputs, targets, mask=mask)
    assert same_state(case.gp, other)


@EXAMPLES
@given(cases(), st.sampled_from([torch.nan, torch.inf, -torch.inf]), st.booleans(), st.integers(0, 10**6))
def test_bad_numbers_are_refused_and_nothing_is_learned(case: Case, bad: float, in_targets: bool, place: int):
    inputs, targets, _ = case.blocks[0]
    if not targets.numel():
        return
    case.gp.update(inputs, targets)
    before = copy.deepcopy(case.gp)
    spoiled = (targets if in_targets else inputs).clone()
    spoiled.view(-1)[place % spoiled.numel()] = bad
    arguments = (inputs, spoiled) if in_targets else (spoiled, targets)
    with pytest.raises(ValueError, match="must be finite: 1 of"):
        case.gp.update(*arguments)
    assert same_state(case.gp, before)


@EXAMPLES
@given(
    cases(), st.sampled_from(["a column too many", "no column", "a point more", "a mask too long", "flat"])
)
def test_wrong_shapes_are_refused_with_the_right_one(case: Case, mistake: str):
    gp, (inputs, targets, _) = case.gp, case.blocks[0]
    mask, dims = None, gp.kernel.input_dim
    if mistake == "a column too many":
        inputs = torch.cat([inputs, inputs[..., :1]], -1)
    elif mistake == "no column":
        inputs = inputs[..., :0]
    elif mistake == "flat":
        inputs = inputs.reshape(-1)
    elif mistake == "a point more":
        targets = torch.zeros(*gp.batch_shape, inputs.shape[-2] + 2)
    else:
        mask = torch.ones(*gp.batch_shape, inputs.shape[-2] + 2, dtype=torch.bool)
    before = copy.deepcopy(gp)
    wanted = f"points, {dims}" if mistake in ("a column too many", "no column", "flat") else "one per input"
    with pytest.raises(ValueError, match=wanted):
        gp.update(inputs, targets, mask=mask)
    assert same_state(gp, before)


@EXAMPLES
@given(cases())
def test_a_copy_goes_on_like_the_original(case: Case):
    *earlier, (inputs, targets, mask) = case.blocks
    for block in earlier:
        case.gp.update(block[0], block[1], mask=block[2])
    other = copy.deepcopy(case.gp)
    for gp in (case.gp, other):
        gp.update(inputs, targets, mask=mask)
    assert same_state(case.gp, other)


@EXAMPLES
@given(cases())
def test_a_loaded_process_goes_on_like_the_saved_one(case: Case):
    *earlier, (inputs, targets, mask) = case.blocks
    other = copy.deepcopy(case.gp)
    for block in earlier:
        case.gp.update(block[0], block[1], mask=block[2])
    other.load_state_dict(case.gp.state_dict())
    for gp in (case.gp, other):
        gp.update(inputs, targets, mask=mask)
    assert same_state(case.gp, other)
