"""Every tensor is made where the data are: on an accelerator that is not there, and on a GPU if there is one.

`Remote` tensors claim to live on another device (torch's "meta", which owns no hardware) and carry their
values along. As on a GPU, an operation that mixes them with tensors of the host fails, unless those have no
dimensions; so does one on a tensor that was made without a value. All else computes as usual, so that the
code for accelerators (whole buffers behind a mask) runs on any machine.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from torch_gprl.gp import SparseOnlineGP, fit_hyperparameters
from torch_gprl.kernels import Columns, GaussianInputs, Kernel, SquaredExponential

ELSEWHERE = torch.device("meta")
HOST = torch.device("cpu")
MAY_CROSS = ("_to_copy", "copy_")  # operations whose purpose is to move values between devices


class Remote(Tensor):
    """A tensor with a value that claims to be on another device."""

    @staticmethod
    def __new__(cls, value: Tensor) -> "Remote":
        layout = {"strides": value.stride(), "storage_offset": value.storage_offset(), "dtype": value.dtype}
        return Tensor._make_wrapper_subclass(cls, value.shape, device=ELSEWHERE, **layout)

    def __init__(self, value: Tensor) -> None:
        self.value = value

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"Remote({self.value!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return compute(func, args, kwargs or {})


class MadeElsewhere(TorchDispatchMode):
    """Operations that are told a device, as `torch.zeros(..., device=...)`, make `Remote` tensors too."""

    synchronisations = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.synchronisations += func is torch.ops.aten._local_scalar_dense.default
        return compute(func, args, kwargs or {})


class BuiltElsewhere(TorchFunctionMode):
    """Tensors made of numbers, `torch.tensor(numbers, device=...)` and `x[..., [0, 2]]`, are missed above."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is Tensor.__getitem__ and isinstance(args[0], Remote) and isinstance(args[1], tuple):
            place = (Remote(torch.tensor(i, dtype=torch.long)) if isinstance(i, list) else i for i in args[1])
            args = (args[0], tuple(place))
        made = func in (torch.tensor, torch.as_tensor) and not isinstance(args[0], Tensor)
        if made and kwargs.get("device") == ELSEWHERE:
            return Remote(func(*args, **{**kwargs, "device": HOST}))
        return func(*args, **kwargs)


def compute(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The operation on the values, with its result on the device where a GPU would leave it."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    remote = [tensor for tensor in tensors if isinstance(tensor, Remote)]
    name = func.overloadpacket.__name__
    strangers = [tuple(tensor.shape) for tensor in tensors if not isinstance(tensor, Remote) and tensor.ndim]
    if remote and strangers and name not in MAY_CROSS:
        raise RuntimeError(f"{name} got tensors of the host, {strangers}, beside some on another device")
    target = kwargs.get("device") or (args[0].device if name in MAY_CROSS else None)
    stays = target == ELSEWHERE if target is not None else bool(remote)
    if kwargs.get("device") is not None:
        kwargs = {**kwargs, "device": HOST}
    result = func(*tree_map(value_of, args), **tree_map(value_of, kwargs))
    known = {id(value_of(tensor)): tensor for tensor in tensors}  # in-place operations return an argument

    def wrap(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor):
            return leaf
        return known[id(leaf)] if id(leaf) in known else Remote(leaf)

    return tree_map(wrap, result) if stays else result


def value_of(leaf: Any) -> Any:
    return leaf.value if isinstance(leaf, Remote) else leaf


@contextmanager
def accelerator() -> Iterator[MadeElsewhere]:
    with MadeElsewhere() as mode, BuiltElsewhere():
        yield mode


def elsewhere(gp: SparseOnlineGP) -> SparseOnlineGP:
    """A copy of the process on the accelerator, as `.to(device)` would make it."""
    twin = copy.deepcopy(gp)
    for module in twin.modules():
        for name, buffer in module.named_buffers(recurse=False):
            module.register_buffer(name, Remote(buffer), persistent=name in module.state_dict())
        for name, parameter in module.named_parameters(recurse=False):
            module.register_parameter(name, nn.Parameter(Remote(parameter.detach())))
    twin.rebase()
    return twin


Move = Callable[[Tensor], Tensor]


def process(shape: tuple[int, ...]) -> SparseOnlineGP:
    """A process over [state, state, action] that has seen few points and will soon be over its budget."""
    states, actions = SquaredExponential(2, 0.7, batch_shape=shape), SquaredExponential(1, batch_shape=shape)
    kernel: Kernel = Columns(states, (0, 1), 3) * Columns(actions, (2,), 3)
    return SparseOnlineGP(kernel, 20, 0.1, batch_shape=shape)


def stream(gp: SparseOnlineGP, move: Move) -> None:
    """Updates of every kind, enough of them to fill the basis and to prune it."""
    generator = torch.Generator().manual_seed(1)
    for count in (20, 1, 30, 8, 40):
        inputs = torch.randn(*gp.batch_shape, count, 3, dtype=torch.float64, generator=generator)
        targets = inputs.sin().sum(-1)
        gp.update(move(inputs), move(targets), stamp=count)
        gp.update(move(inputs), move(targets), mask=move(targets > 0))
        gp.update(move(inputs), move(targets), next_inputs=move(inputs + 0.1), discount=0.9)
        after = GaussianInputs(move(inputs + 0.1), move(0.1 * torch.ones_like(inputs[..., 2:])), (2,))
        gp.update(move(inputs), move(targets), next_inputs=after, discount=move(0.5 * (targets > 0).double()))


POINTS = torch.linspace(-2, 2, 30, dtype=torch.float64).reshape(10, 3)


def posterior(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    return gp.posterior(move(POINTS))


def joint(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    joint = gp.joint(move(POINTS))
    return joint.mean, joint.covariance_matrix


def parameters_of_the_recursion(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    return gp.mean(move(POINTS)), gp.alpha, gp.C, gp.size, gp.stamps


def evidence_and_its_gradient(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    evidence = gp.log_marginal_likelihood()
    return evidence, *torch.autograd.grad(evidence.sum(), list(gp.kernel.parameters()))


def another_kernel(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    with torch.no_grad():
        for parameter in gp.kernel.parameters():
            parameter.add_(0.1)
    return gp.posterior(move(POINTS))


def twins_merged(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    gp.merge(copy.deepcopy(gp))
    return gp.posterior(move(POINTS))


def fitted(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    inputs = torch.randn(16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    accepted = fit_hyperparameters(gp, move(inputs), move(inputs.sum(-1)), steps=3)
    return accepted, *(parameter.detach() for parameter in gp.parameters()), *gp.posterior(move(POINTS))


def forgotten(gp: SparseOnlineGP, move: Move) -> tuple[Tensor, ...]:
    gp.reset()
    return gp.posterior(move(POINTS))


READINGS = (
    posterior, joint, parameters_of_the_recursion, evidence_and_its_gradient,
    another_kernel, twins_merged, fitted, forgotten,
)  # fmt: skip


@pytest.fixture(scope="module", params=[(), (2,)], ids=["alone", "learners"])
def pair(request) -> tuple[SparseOnlineGP, SparseOnlineGP]:
    """The same stream learned on the host and on the accelerator."""
    here = process(request.param)
    with accelerator():
        there = elsewhere(here)
        stream(there, Remote)
    stream(here, Tensor.clone)
    return here, there


@pytest.mark.parametrize("reading", READINGS, ids=lambda reading: reading.__name__)
def test_an_accelerator_computes_what_the_host_does_and_meets_no_tensor_of_the_host(pair, reading):
    here, there = copy.deepcopy(pair)
    assert here.size.min() >= here.budget  # full
    with accelerator():
        result = reading(there, Remote)
    for mine, theirs in zip(reading(here, Tensor.clone), result, strict=True):
        assert isinstance(theirs, Remote)
        torch.testing.assert_close(theirs.value.detach(), mine.detach(), rtol=1e-8, atol=1e-8)


def test_reading_a_fresh_posterior_does_not_wait_for_the_accelerator(pair):
    gp = copy.deepcopy(pair[1])
    with accelerator() as mode:
        gp.refresh()
        mode.synchronisations = 0
        gp.posterior(Remote(POINTS))
        assert mode.synchronisations == 0
        gp.update(Remote(POINTS), Remote(POINTS.sum(-1)))
        assert mode.synchronisations > 0  # the counter counts


def test_the_pretended_accelerator_notices_tensors_of_the_host():
    ones = torch.ones(3, dtype=torch.float64)
    with accelerator():
        assert isinstance(torch.zeros(3, device=ELSEWHERE) + torch.tensor([1.0], device=ELSEWHERE), Remote)
        assert isinstance(2.0 * Remote(ones).to(torch.float32), Remote)
        assert not isinstance(Remote(ones).to(HOST), Remote)
        with pytest.raises(RuntimeError, match="tensors of the host"):
            Remote(ones) + torch.ones(3)
        with pytest.raises(RuntimeError, match="tensors of the host"):
            Remote(ones)[torch.tensor([0, 1])]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("reading", READINGS, ids=lambda reading: reading.__name__)
@pytest.mark.parametrize("shape", [(), (2,)], ids=["alone", "learners"])
def test_a_gpu_computes_what_the_host_does(shape, reading):
    here = process(shape)
    there = copy.deepcopy(here).to("cuda")
    stream(here, Tensor.clone)
    stream(there, Tensor.cuda)
    for mine, theirs in zip(reading(here, Tensor.clone), reading(there, Tensor.cuda), strict=True):
        assert theirs.device.type == "cuda"
        torch.testing.assert_close(theirs.detach().cpu(), mine.detach(), rtol=1e-7, atol=1e-7)
