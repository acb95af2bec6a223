"""The guarded Cholesky: exact where it can be, honest where it cannot."""

import pytest
import torch

from torch_gprl.linalg import CholeskyError, cholesky


def positive_definite(*batch: int, size: int = 5, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    root = torch.randn(*batch, size, size, dtype=dtype)
    return root @ root.mT + torch.eye(size, dtype=dtype)


def singular(size: int = 5) -> torch.Tensor:
    """Positive semi-definite of rank 2, with roundoff that makes its smallest eigenvalue negative."""
    root = torch.randn(size, 2, dtype=torch.float64)
    return root @ root.mT - 1e-15 * torch.eye(size, dtype=torch.float64)


def test_the_factor_is_lower_triangular_and_its_square_is_the_matrix():
    matrix = positive_definite(3, 2)
    factor = cholesky(matrix)
    assert torch.equal(factor, factor.tril())
    torch.testing.assert_close(factor @ factor.mT, matrix, rtol=1e-13, atol=1e-13)


def test_only_the_entries_that_fail_get_jitter():
    good, bad = positive_definite(), singular()
    factor = cholesky(torch.stack([good, bad]))
    assert torch.equal(factor[0], cholesky(good))
    added = (factor[1] @ factor[1].mT - bad).diagonal() / bad.diagonal().mean()
    assert (added > 0).all()
    assert (added < 1e-11).all()


def test_jitter_grows_no_further_than_needed():
    basis, _ = torch.linalg.qr(torch.randn(4, 4, dtype=torch.float64))
    matrix = basis @ torch.diag(torch.tensor([1.0, 1.0, 1.0, -1e-10], dtype=torch.float64)) @ basis.mT
    factor = cholesky(matrix)
    added = (factor @ factor.mT - matrix).diagonal().mean()
    assert 1e-10 < added < 1e-9


def test_jitter_scales_with_the_matrix():
    matrix = singular()
    torch.testing.assert_close(cholesky(1e8 * matrix), 1e4 * cholesky(matrix), rtol=1e-4, atol=1e-3)


def test_jitter_can_be_forbidden():
    with pytest.raises(CholeskyError, match="positive definite"):
        cholesky(singular(), max_jitter=0.0)


def test_an_indefinite_matrix_is_refused_with_its_size_eigenvalue_jitter_and_ways_out():
    matrix = torch.diag(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64))
    with pytest.raises(CholeskyError) as error:
        cholesky(matrix.expand(2, 3, 3))
    for part in (
        "got 2",
        "size 3",
        "torch.float64",
        "eigenvalue -0.5",
        "1e-08 of the mean",
        "noise variance",
    ):
        assert part in str(error.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("place", [(0, 0), (3, 1), (4, 4)])
def test_a_matrix_with_a_number_that_is_none_says_so(value: float, place: tuple[int, int]):
    matrix = positive_definite()
    matrix[place] = matrix[place[::-1]] = value
    with pytest.raises(CholeskyError, match=r"needs finite numbers, got .* shape \(5, 5\)"):
        cholesky(matrix)


def test_float32_gets_as_many_of_its_digits_as_float64():
    matrix = torch.ones(4, 4)  # rank one
    factor = cholesky(matrix)
    assert factor.dtype == torch.float32
    torch.testing.assert_close(factor @ factor.mT, matrix, rtol=1e-3, atol=0)


def test_a_matrix_without_rows_has_a_factor_without_rows():
    assert cholesky(torch.zeros(2, 0, 0)).shape == (2, 0, 0)


def test_the_factor_is_differentiable_with_and_without_jitter():
    def log_determinant(root: torch.Tensor) -> torch.Tensor:
        return cholesky(root @ root.mT + torch.eye(3, dtype=torch.float64)).diagonal().log().sum()

    assert torch.autograd.gradcheck(
        log_determinant, torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    )
    matrix = singular().requires_grad_()
    cholesky(matrix).sum().backward()
    assert matrix.grad is not None
    assert matrix.grad.isfinite().all()
