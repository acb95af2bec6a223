"""The state of a sparse Gaussian process, and everything that can be read from it.

The data leave behind a Gaussian term in the basis values u = f(X_B) = L w, L = chol K(X_B, X_B), and nothing
else. With φ(x) = L⁻¹k(X_B, x), prior w ~ N(0, I) and ν(x) = k(x, x) − φᵀφ, what the basis misses of x,

    A = I + Σ φφᵀ/(σ0² + ν),   b = Σ φ y/(σ0² + ν),   w | data ~ N(A⁻¹b, A⁻¹).

Buffers have a fixed number of rows, with a count per learner: state_dict, weight sync to workers and batching
never see a shape change. What is derived from them is remembered and renewed when they, or the kernel's
parameters, have changed.

| paper | here | meaning |
|---|---|---|
| X_B | `basis` | basis vectors, rows of zeros where unused |
| L | `gram_factor` | Cholesky factor of the basis' Gram matrix, identity rows where unused |
| A, b | `precision`, `information` | posterior precision of w, and precision times mean |
| σ0² | `noise_variance` | variance of the noise on targets |
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from torch_gprl.gp.door import admit_inputs, admit_points
from torch_gprl.gp.posterior import Posterior
from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.linalg import cholesky

# Novelty below this part of the prior variance is roundoff, and no reason to add a basis vector.
NOVELTY_FLOOR = {torch.float64: 1e-10, torch.float32: 1e-4}


class Active(NamedTuple):
    """The rows in use, up to those of the largest basis among the learners."""

    rows: int
    basis: Float[Tensor, "*batch R D"]
    cross: Callable[[Tensor], Tensor]  # x ↦ k(X_B, x)
    gram_factor: Float[Tensor, "*batch R R"]
    mask: Bool[Tensor, "*batch R 1"] | None  # which of them are a learner's own; None if all are


class Solved(NamedTuple):
    """The posterior of w in the rows in use."""

    precision_factor: Float[Tensor, "*batch R R"]  # Cholesky factor of A
    weights: Float[Tensor, "*batch R"]  # A⁻¹b
    alpha: Float[Tensor, "*batch R"]  # L⁻ᵀA⁻¹b


class WhitenedState(nn.Module):
    """Basis, pseudo-likelihood, prior, and the posterior that they make.

    Args:
        kernel: covariance function.
        capacity: rows of the buffers.
        noise_variance: σ0², a number or [*batch].
        batch_shape: leading dimensions of everything.

    Raises:
        ValueError: a noise variance that is not positive and finite, or a kernel neither float64 nor float32.
    """

    basis: Float[Tensor, "*batch B D"]
    gram_factor: Float[Tensor, "*batch B B"]
    precision: Float[Tensor, "*batch B B"]
    information: Float[Tensor, "*batch B"]
    size: Int[Tensor, "*batch"]
    stamps: Int[Tensor, "*batch B"]
    clock: Int[Tensor, ""]
    evidence_constant: Float[Tensor, "*batch"]
    observations: Int[Tensor, "*batch"]
    precision_factor: Float[Tensor, "*batch B B"]
    weights: Float[Tensor, "*batch B"]

    def __init__(
        self, kernel: Kernel, capacity: int, noise_variance: float | Tensor, batch_shape: torch.Size
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.capacity = capacity
        self.batch_shape = batch_shape
        like = next(kernel.parameters())
        _check_dtype(like.dtype)
        noise = torch.as_tensor(noise_variance, dtype=like.dtype, device=like.device).expand(batch_shape)
        if not bool((torch.isfinite(noise) & (noise > 0)).all()):
            raise ValueError(f"noise_variance must be positive and finite, got {noise_variance}")
        self.log_noise_variance = nn.Parameter(noise.log().clone())
        self._register_state(like)
        self.register_state_dict_pre_hook(_before_save)
        self.register_load_state_dict_post_hook(_after_load)
        self._accept_state()

    def _register_state(self, like: Tensor) -> None:
        batch, rows, dims = self.batch_shape, self.capacity, self.kernel.input_dim
        eye = torch.eye(rows, dtype=like.dtype, device=like.device).expand(*batch, rows, rows)
        integer = {"dtype": torch.long, "device": like.device}
        self.register_buffer("basis", like.new_zeros(*batch, rows, dims))
        self.register_buffer("gram_factor", eye.clone())
        self.register_buffer("precision", eye.clone())
        self.register_buffer("information", like.new_zeros(*batch, rows))
        self.register_buffer("size", torch.zeros(batch, **integer))
        self.register_buffer("stamps", torch.zeros(*batch, rows, **integer))
        self.register_buffer("clock", torch.zeros((), **integer))
        self.register_buffer("evidence_constant", like.new_zeros(batch))
        self.register_buffer("observations", torch.zeros(batch, **integer))
        # derived from the above for compiled readers, see `refresh`
        self.register_buffer("precision_factor", eye.clone(), persistent=False)
        self.register_buffer("weights", like.new_zeros(*batch, rows), persistent=False)

    # ---------------------------------------------------------------- reading

    @property
    def noise_variance(self) -> Float[Tensor, "*batch"]:
        """σ0² [*batch]."""
        return self.log_noise_variance.exp()

    @property
    def mask(self) -> Bool[Tensor, "*batch B"]:
        """Which rows of the buffers are in use, [*batch, capacity]."""
        return torch.arange(self.capacity, device=self.size.device) < self.size.unsqueeze(-1)

    @property
    def alpha(self) -> Float[Tensor, "*batch B"]:
        """α = L⁻ᵀA⁻¹b: the posterior mean is k(x, X_B) α; zero where unused."""
        alpha = self._solved().alpha
        return pad(alpha, (0, self.capacity - alpha.shape[-1]))

    @property
    def C(self) -> Float[Tensor, "*batch B B"]:
        """C = L⁻ᵀ(A⁻¹ − I)L⁻¹ ⪯ 0, Csató's sign: the variance is k(x, x) + k(x, X_B) C k(X_B, x)."""
        factor, gram_factor = self._solved().precision_factor, self._active().gram_factor
        rows = gram_factor.shape[-1]
        eye = torch.eye(rows, dtype=factor.dtype, device=factor.device)
        inverse_factor = solve_triangular(gram_factor, eye.expand_as(gram_factor))
        half = solve_triangular(factor, inverse_factor)
        unused = self.capacity - rows
        return pad(half.mT @ half - inverse_factor.mT @ inverse_factor, (0, unused, 0, unused))

    def posterior(self, inputs: Float[Tensor, "*#batch N D"] | GaussianInputs) -> Posterior:
        """Mean and variance of f (without noise) at `inputs`, [*batch, N] each; differentiable in them.

        The gradient in the kernel's parameters is not the whole one: the basis' Gram factor counts as a
        constant. To fit parameters take `log_marginal_likelihood`.

        For `GaussianInputs` those of the average of f over the Gaussian columns, in closed form.
        """
        solved = self._solved()
        inputs = admit_points(inputs, self.batch_shape, self.basis)
        phi = self._features(inputs)
        half = solve_triangular(solved.precision_factor, phi)
        # k** − φᵀφ + φᵀA⁻¹φ
        variance = self._prior_variance(inputs) - squared_columns(phi) + squared_columns(half)
        return Posterior((phi.mT @ solved.weights.unsqueeze(-1)).squeeze(-1), variance)

    def mean(self, inputs: Float[Tensor, "*#batch N D"] | GaussianInputs) -> Float[Tensor, "*batch N"]:
        """Posterior mean alone [*batch, N], several times cheaper than `posterior`."""
        inputs = admit_points(inputs, self.batch_shape, self.basis)
        cross = self._cross(inputs, self._active())
        return (cross.mT @ self._solved().alpha.unsqueeze(-1)).squeeze(-1)

    def forward(
        self, inputs: Float[Tensor, "*#batch N D"]
    ) -> tuple[Float[Tensor, "*batch N"], Float[Tensor, "*batch N"]]:
        """(mean, variance) of f at `inputs`, each [*batch, N]."""
        posterior = self.posterior(inputs)
        return posterior.mean, posterior.variance

    def joint(self, inputs: Float[Tensor, "*#batch N D"]) -> torch.distributions.MultivariateNormal:
        """Joint posterior of f at `inputs`, for sampling whole functions."""
        solved = self._solved()
        inputs = admit_inputs(inputs, self.batch_shape, self.basis)
        phi = self._features(inputs)
        half = solve_triangular(solved.precision_factor, phi)
        covariance = self.kernel(inputs, inputs) - phi.mT @ phi + half.mT @ half
        mean = (phi.mT @ solved.weights.unsqueeze(-1)).squeeze(-1)
        factor = cholesky(covariance)
        return torch.distributions.MultivariateNormal(mean, scale_tril=factor, validate_args=False)

    def log_marginal_likelihood(self) -> Float[Tensor, "*batch"]:
        """Log p(targets) of the streaming model [*batch]: −½ log|A| + ½ bᵀA⁻¹b plus the data's own constant.

        Exact for the dense GP when nothing was projected, the FITC evidence on a fixed basis. Differentiable
        in the kernel's parameters, with the pseudo-likelihood of the basis held fixed.
        """
        precision, information = self._whiten(cholesky(self._gram()))
        factor = cholesky(precision)
        half = solve_triangular(factor, information.unsqueeze(-1))
        log_determinant = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self.evidence_constant + 0.5 * (half.square().sum((-2, -1)) - log_determinant)

    # ---------------------------------------------------------------- keeping derived things fresh

    @torch.no_grad()
    def refresh(self) -> None:
        """Bring what is derived up to date with state and kernel; does nothing when it is.

        Changes are seen by the version counters of the tensors, so weight sync and optimisers need not tell.
        A compiled caller sees the changes that went through this object's own methods.
        """
        self._solved()

    @torch.no_grad()
    def _solved(self) -> Solved:
        if torch.compiler.is_compiling():  # then all rows are in use, and buffers remember
            if self._stale:
                solved = _solve(self.gram_factor, self.precision, self.information)
                self.precision_factor.copy_(solved.precision_factor)
                self.weights.copy_(solved.weights)
                self._stale = False
            return Solved(self.precision_factor, self.weights, _coefficients(self.gram_factor, self.weights))
        if self._kernel_versions() != self._kernel_seen:
            self.rebase()
        seen = self._versions("gram_factor", "precision", "information")
        if self._solution is None or seen != self._solution_seen:
            active = self._active()
            used = slice(active.rows)
            precision, information = self.precision[..., used, used], self.information[..., used]
            self._solution = _solve(active.gram_factor, precision, information)
            self._solution_seen = seen
        return self._solution

    @torch.no_grad()
    def rebase(self) -> None:
        """Take over the kernel's present parameters; reading and learning do so by themselves.

        The pseudo-likelihood of the basis values stays; prior, factors and posterior follow the new kernel.
        """
        gram_factor = cholesky(self._gram())
        precision, information = self._whiten(gram_factor)
        self.gram_factor.copy_(gram_factor)
        self.precision.copy_(precision)
        self.information.copy_(information)
        self._accept_state()

    def _accept_state(self) -> None:
        """The state was just made for the present kernel; everything derived from it is out of date."""
        self._stale = True
        # a kernel on a graph changes with the graph, which it keeps in buffers
        self._kernel_tensors = [*self.kernel.parameters(), *self.kernel.buffers()]
        self._kernel_seen = self._kernel_versions()
        self._solution: Solved | None = None
        self._active_rows: Active | None = None
        self._in_use: Any = None  # arrays of a learner that is alone, see `one_point`
        self._reader: Any = None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "WhitenedState":
        super()._apply(fn, recurse)
        _check_dtype(self.basis.dtype)
        self._accept_state()
        return self

    def __getstate__(self) -> dict[str, Any]:
        """Without what is derived, which a copy makes anew."""
        _before_save(self, "", False)
        return {**self.__dict__, "_active_rows": None, "_in_use": None, "_reader": None, "_solution": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._accept_state()  # a copied state is up to date with the copied kernel

    def _versions(self, *names: str) -> tuple[int, ...]:
        """What changes when these buffers do; read where a module keeps them, at half the price."""
        buffers = [self._buffers[name] for name in names]
        return *[buffer._version for buffer in buffers if buffer is not None], *map(id, buffers)

    def _kernel_versions(self) -> tuple[int, ...]:
        return id(self._modules["kernel"]), *[tensor._version for tensor in self._kernel_tensors]

    def _is_alone(self) -> bool:
        """Whether there is one learner, on the CPU, which may go the short way."""
        size = self._buffers["size"]
        return size is not None and size.numel() == 1 and size.is_cpu

    def _active(self) -> Active:
        """The rows in use. On a GPU all rows: asking how many are used would wait for the device."""
        if torch.compiler.is_compiling() or not self.size.is_cpu:
            cross = partial(self.kernel, self.basis)
            return Active(self.capacity, self.basis, cross, self.gram_factor, self.mask.unsqueeze(-1))
        seen = self._versions("basis", "gram_factor")
        if self._active_rows is None or seen != self._active_seen:
            sizes = self.size.flatten().tolist()
            rows = max(sizes, default=0)
            if len(sizes) > 1 and 4 * rows > 3 * self.capacity:
                rows = self.capacity  # work on the others costs less than a copy of those in use
            mask = None if min(sizes, default=0) == rows else self.mask[..., :rows].unsqueeze(-1)
            basis = self.basis[..., :rows, :].contiguous()
            factor = self.gram_factor[..., :rows, :rows].contiguous()  # as triangular solvers want it
            self._active_rows = Active(rows, basis, self.kernel.against(basis), factor, mask)
            self._active_seen = seen
        return self._active_rows

    # ---------------------------------------------------------------- inside

    def _cross(self, inputs: Tensor | GaussianInputs, active: Active) -> Float[Tensor, "*batch R N"]:
        """Covariance of f, or of its average over Gaussian columns, with the basis values."""
        if isinstance(inputs, GaussianInputs):
            return self.kernel.expected(inputs, active.basis).mT
        return active.cross(inputs)

    def _features(self, inputs: Tensor | GaussianInputs) -> Float[Tensor, "*batch R N"]:
        """φ = L⁻¹ k(X_B, x) in columns, for the rows in use."""
        active = self._active()
        cross = self._cross(inputs, active)
        return solve_triangular(active.gram_factor, cross if active.mask is None else cross * active.mask)

    def _prior_variance(self, inputs: Tensor | GaussianInputs) -> Float[Tensor, "*batch N"]:
        """Prior variance of f, or of its average over Gaussian columns, at each point."""
        if isinstance(inputs, GaussianInputs):
            return self.kernel.expected_pairs(inputs, inputs)
        return self.kernel.diag(inputs)

    def _gram(self) -> Float[Tensor, "*batch B B"]:
        """K(X_B, X_B) with identity rows where unused, under the kernel's present parameters."""
        used = self.mask.unsqueeze(-1) & self.mask.unsqueeze(-2)
        eye = torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device)
        return torch.where(used, self.kernel(self.basis, self.basis), eye)

    def _whiten(self, gram_factor: Tensor) -> tuple[Tensor, Tensor]:
        """(A, b) of the same pseudo-likelihood in the coordinates of another Gram factor L' = L G."""
        change = solve_triangular(self.gram_factor, gram_factor)  # G
        eye = torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device)
        precision = eye + change.mT @ (self.precision - eye) @ change  # I + L'ᵀΛL'
        return precision, (change * self.information.unsqueeze(-1)).sum(-2)  # L'ᵀh


def _check_dtype(dtype: torch.dtype) -> None:
    if dtype not in NOVELTY_FLOOR:
        raise ValueError(f"a Gaussian process needs a kernel in float64 (or float32), got {dtype}")
    if dtype != torch.float64:
        warnings.warn(
            f"this Gaussian process keeps its state in {dtype}: novelty below {NOVELTY_FLOOR[dtype]:g} of "
            "the prior variance is lost in rounding; float64 costs little, and only memory speaks against it",
            stacklevel=3,
        )


def _before_save(module: nn.Module, prefix: str, keep_vars: bool) -> None:
    """What is saved belongs to the kernel that is saved with it."""
    assert isinstance(module, WhitenedState)
    if module._kernel_versions() != module._kernel_seen:
        module.rebase()


def _after_load(module: nn.Module, keys: object) -> None:
    """A loaded state brings its own kernel parameters along."""
    assert isinstance(module, WhitenedState)
    module._accept_state()


def solve_triangular(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
    """F⁻¹ R for a triangular F, lower unless told."""
    return torch.linalg.solve_triangular(factor, right, upper=upper)


def squared_columns(matrix: Tensor) -> Tensor:
    """Squared norm of each column [*batch, N]."""
    if matrix.requires_grad:  # the norm of a column of zeros has no second derivative
        return torch.linalg.vecdot(matrix, matrix, dim=-2)
    return torch.linalg.vector_norm(matrix, dim=-2).square()  # makes no copy of the matrix


def _solve(gram_factor: Tensor, precision: Tensor, information: Tensor) -> Solved:
    factor = cholesky(precision)
    half = solve_triangular(factor, information.unsqueeze(-1))
    weights = solve_triangular(factor.mT, half, upper=True).squeeze(-1)
    return Solved(factor, weights, _coefficients(gram_factor, weights))


def _coefficients(gram_factor: Tensor, weights: Tensor) -> Tensor:
    """α = L⁻ᵀ A⁻¹b."""
    return solve_triangular(gram_factor.mT, weights.unsqueeze(-1), upper=True).squeeze(-1)
