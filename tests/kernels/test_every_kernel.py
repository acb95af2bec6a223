"""What holds for every kernel: a covariance, batched, broadcasting, differentiable."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import functional_call

from torch_gprl.kernels import Kernel

Make = Callable[..., Kernel]


def points(*shape: int) -> Tensor:
    return torch.randn(*shape, 3, dtype=torch.float64)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    spread=st.sampled_from([1e-6, 0.1, 1.0, 100.0]),
    offset=st.sampled_from([0.0, -3.0, 1e4]),
    count=st.integers(1, 40),
)
def test_gram_matrices_are_symmetric_and_positive_semi_definite(
    make: Make, seed: int, spread: float, offset: float, count: int
):
    torch.manual_seed(seed)
    x = offset + spread * points(count)
    x = torch.cat([x, x[: count // 3]])  # and duplicates
    gram = make(())(x, x).detach()
    torch.testing.assert_close(gram, gram.mT, rtol=0, atol=1e-13 * float(gram.abs().max()))
    assert torch.linalg.eigvalsh(gram)[0] >= -1e-10 * gram.trace()


@pytest.mark.parametrize("count", [4, 700])  # either way to compute distances
def test_the_diagonal_is_the_diagonal_of_the_gram_matrix(make: Make, count: int):
    kernel, x = make(()), points(count)
    torch.testing.assert_close(kernel(x, x).diagonal(), kernel.diag(x), rtol=1e-14, atol=0)
    torch.testing.assert_close(kernel(x, x.clone()).diagonal(), kernel.diag(x), rtol=1e-6, atol=0)


def test_swapping_the_arguments_transposes(make: Make):
    kernel, x, z = make(()), points(6), points(4)
    torch.testing.assert_close(kernel(x, z), kernel(z, x).mT, rtol=1e-13, atol=1e-14)


def test_each_learner_of_a_batch_has_a_kernel_of_its_own(make: Make):
    batched, x, z = make((2,)), points(2, 5), points(2, 4)
    assert batched.batch_shape == (2,)
    for learner in range(2):
        single = make(())
        state = {
            name: value[learner]
            if value.shape[:1] == (2,) and value.ndim > single.state_dict()[name].ndim
            else value
            for name, value in batched.state_dict().items()
        }
        single.load_state_dict(state)
        torch.testing.assert_close(
            batched(x, z)[learner], single(x[learner], z[learner]), rtol=1e-12, atol=1e-14
        )
        torch.testing.assert_close(batched.diag(x)[learner], single.diag(x[learner]))


def test_batches_broadcast(make: Make):
    x, z = points(5), points(7, 1, 4)
    assert make(())(x, z).shape == (7, 1, 5, 4)
    assert make((2,))(x, z).shape == (7, 2, 5, 4)
    assert make((2,)).diag(x).shape == (2, 5)
    torch.testing.assert_close(make(())(x, z)[3, 0], make(())(x, z[3, 0]))


def test_no_points_give_an_empty_matrix(make: Make):
    assert make((2,))(points(0), points(2, 4)).shape == (2, 0, 4)
    assert make(())(points(4), points(0)).shape == (4, 0)


def test_the_result_is_the_same_with_and_without_gradients(make: Make):
    kernel, x, z = make(()), points(6), points(4)
    with torch.no_grad():
        without = kernel(x, z)
    torch.testing.assert_close(kernel(x, z), without, rtol=1e-12, atol=1e-13)


def test_gradients_agree_with_finite_differences(make: Make):
    kernel = make((2,))
    names = [name for name, _ in kernel.named_parameters()]

    def covariance(x: Tensor, z: Tensor, *parameters: Tensor) -> Tensor:
        return functional_call(kernel, dict(zip(names, parameters, strict=True)), (x, z))

    arguments = points(4).requires_grad_(), points(2, 3).requires_grad_(), *kernel.parameters()
    assert torch.autograd.gradcheck(covariance, arguments)


def test_the_gradient_at_coincident_points_is_finite(make: Make):
    kernel, x = make(()), points(4).requires_grad_()
    z = x.detach().clone().requires_grad_()
    for gram in (kernel(x, x), kernel(x, z)):
        gradients = torch.autograd.grad(gram.sum(), [x, *kernel.parameters()])
        assert all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize(
    "make", ["squared exponential", "rational quadratic", "periodic", "linear"], indirect=True
)
def test_smooth_kernels_have_second_derivatives_also_at_coincident_points(make: Make):
    kernel, x = make(()), points(3).requires_grad_()
    z = torch.cat([x.detach()[:1], points(2)]).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x, z: kernel(x, z), (x, z))


def test_a_kernel_in_single_precision_gives_the_same_to_single_precision(make: Make):
    x, z = points(6), points(4)
    single = make(()).to(torch.float32)(x.float(), z.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), make(())(x, z), rtol=1e-4, atol=1e-5)


def test_single_precision_inputs_are_computed_with_in_double(make: Make):
    x, z = points(6).float(), points(4).float()
    torch.testing.assert_close(make(())(x, z), make(())(x.double(), z.double()))


def test_an_expansion_is_the_weighted_sum_of_covariances_and_differentiable(make: Make):
    kernel, z, weights = make((2,)), points(2, 4), torch.randn(2, 4, 3, dtype=torch.float64)
    x = points(2, 5).requires_grad_(True)
    theirs, ours = kernel(x, z) @ weights, kernel.expansion(z, weights)(x)
    torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)
    slopes = [torch.autograd.grad(values.sum(), x)[0] for values in (ours, theirs)]
    torch.testing.assert_close(*slopes, rtol=1e-8, atol=1e-10)
