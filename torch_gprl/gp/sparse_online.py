"""The sparse online Gaussian process: a basis and a Gaussian pseudo-likelihood on it, kept whitened.

The data leave behind a Gaussian term in the basis values u = f(X_B) = L w, L = chol K(X_B, X_B), and nothing
else. With φ(x) = L⁻¹k(X_B, x), prior w ~ N(0, I) and ν(x) = k(x, x) − φᵀφ, what the basis misses of x,

    A = I + Σ φφᵀ/(σ0² + ν),   b = Σ φ y/(σ0² + ν),   w | data ~ N(A⁻¹b, A⁻¹).

Sums over data: a block of points is one matrix product, their order does not matter, learners merge by
adding. Sources: Csató and Opper (2002), "Sparse on-line Gaussian processes"; the thesis' equations (.5) to
(.13). The textbook recursion in α, C and K⁻¹, which loses its digits, is `RecursiveGP`.

| paper | here | meaning |
|---|---|---|
| X_B | `basis` | basis vectors, rows of zeros where unused |
| L | `gram_factor` | Cholesky factor of the basis' Gram matrix, identity rows where unused |
| A, b | `precision`, `information` | posterior precision of w, and precision times mean |
| γ_{n+1} (.10) | novelty | ν above |
| σ0² | `noise_variance` | variance of the noise on targets |
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torch_gprl.gp.door import admit_data, admit_inputs
from torch_gprl.gp.posterior import Posterior
from torch_gprl.gp.pruning import BasisStatistics, InformationScore, PruningScore, Whitened, keep_first
from torch_gprl.gp.selection import Selection, select_novel
from torch_gprl.kernels.base import Kernel
from torch_gprl.linalg import cholesky

BLOCK = 256  # points absorbed at once; longer updates are cut into blocks of this size
CHURN = 8  # a full basis admits at most one in so many points of a block: every swap projects the past
NOVELTY_FLOOR = {torch.float64: 1e-10, torch.float32: 1e-4}  # of the prior variance: below is roundoff


class SparseOnlineGP(nn.Module):
    """Gaussian process regression on a stream, with at most a budget of basis vectors.

    Works as plain torch: `gp.update(inputs, targets)`, then `mean, variance = gp(inputs)`. All tensors carry
    the leading dimensions `batch_shape`, independent learners that share nothing but the program.

    Args:
        kernel: covariance function; its `batch_shape` broadcasts to `batch_shape`.
        budget: basis vectors kept by each round of pruning.
        noise_variance: σ0², variance of the noise on targets, a number or [*batch]; a parameter of the model.
        novelty_threshold: a point joins the basis if its novelty exceeds this many times σ0².
        batch_shape: leading dimensions; those of the kernel unless told.
        pruning: score of the basis vectors, the smallest go; `InformationScore()` unless told.
        projection: `"moment"` keeps the posterior of the basis values exact when a point is projected or a
            vector deleted (FITC); `"dtc"` is the overconfident form of Csató's toolbox.
        order: `"novelty"` picks new basis vectors from a block by largest novelty; `"arrival"` takes the
            points one by one, as the textbook recursion does.
        overshoot: vectors above the budget that may gather before a round of pruning takes them at once;
            min(budget / 4, 64) unless told. 1 prunes after every addition.

    Raises:
        ValueError: an option out of its range; the message says which and what would be valid.
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

    def __init__(  # the public signature of the design: each name is a word of the method
        self,
        kernel: Kernel,
        budget: int,
        noise_variance: float | Tensor = 1e-2,
        novelty_threshold: float = 0.3,
        batch_shape: tuple[int, ...] | None = None,
        *,
        pruning: PruningScore | None = None,
        projection: Literal["moment", "dtc"] = "moment",
        order: Literal["novelty", "arrival"] = "novelty",
        overshoot: int | None = None,
    ) -> None:
        super().__init__()
        _check_options(budget, novelty_threshold, projection, order, overshoot)
        self.kernel = kernel
        self.budget = budget
        self.novelty_threshold = novelty_threshold
        self.pruning = InformationScore() if pruning is None else pruning
        self.projection: Literal["moment", "dtc"] = projection
        self.order: Literal["novelty", "arrival"] = order
        self.overshoot = max(1, min(budget // 4, 64)) if overshoot is None else overshoot
        self.capacity = budget + self.overshoot
        self.batch_shape = torch.Size(kernel.batch_shape if batch_shape is None else batch_shape)
        like = next(kernel.parameters())
        noise = torch.as_tensor(noise_variance, dtype=like.dtype, device=like.device).expand(self.batch_shape)
        if not bool((torch.isfinite(noise) & (noise > 0)).all()):
            raise ValueError(f"noise_variance must be positive and finite, got {noise_variance}")
        self.log_noise_variance = nn.Parameter(noise.log().clone())
        self._register_state(like)
        self.register_load_state_dict_post_hook(lambda module, _: module._forget_factors())

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
        # derived from the above, refreshed lazily
        self.register_buffer("precision_factor", eye.clone(), persistent=False)
        self.register_buffer("weights", like.new_zeros(*batch, rows), persistent=False)
        self._stale = False

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
        self.refresh()
        return _solve(self.gram_factor.mT, self.weights.unsqueeze(-1), upper=True).squeeze(-1)

    @property
    def C(self) -> Float[Tensor, "*batch B B"]:
        """C = L⁻ᵀ(A⁻¹ − I)L⁻¹ ⪯ 0, Csató's sign: the variance is k(x, x) + k(x, X_B) C k(X_B, x)."""
        self.refresh()
        inverse_factor = self._inverse_gram_factor()
        half = _solve(self.precision_factor, inverse_factor)
        return half.mT @ half - inverse_factor.mT @ inverse_factor

    def posterior(self, inputs: Float[Tensor, "*#batch N D"]) -> Posterior:
        """Mean and variance of f (without noise) at `inputs`, [*batch, N] each; differentiable in them."""
        self.refresh()
        inputs = admit_inputs(inputs, self.batch_shape, self.basis)
        phi = self._features(inputs)
        mean = (phi * self.weights.unsqueeze(-1)).sum(-2)
        explained, left = phi.square().sum(-2), _solve(self.precision_factor, phi).square().sum(-2)
        return Posterior(mean, self.kernel.diag(inputs) - explained + left)  # k** − φᵀφ + φᵀA⁻¹φ

    def mean(self, inputs: Float[Tensor, "*#batch N D"]) -> Float[Tensor, "*batch N"]:
        """Posterior mean alone [*batch, N], several times cheaper than `posterior`."""
        inputs = admit_inputs(inputs, self.batch_shape, self.basis)
        return (self.kernel(inputs, self.basis) @ self.alpha.unsqueeze(-1)).squeeze(-1)

    def forward(
        self, inputs: Float[Tensor, "*#batch N D"]
    ) -> tuple[Float[Tensor, "*batch N"], Float[Tensor, "*batch N"]]:
        """(mean, variance) of f at `inputs`, each [*batch, N]."""
        posterior = self.posterior(inputs)
        return posterior.mean, posterior.variance

    def joint(self, inputs: Float[Tensor, "*#batch N D"]) -> torch.distributions.MultivariateNormal:
        """Joint posterior of f at `inputs`, for sampling whole functions."""
        self.refresh()
        inputs = admit_inputs(inputs, self.batch_shape, self.basis)
        phi = self._features(inputs)
        half = _solve(self.precision_factor, phi)
        covariance = self.kernel(inputs, inputs) - phi.mT @ phi + half.mT @ half
        mean = (phi * self.weights.unsqueeze(-1)).sum(-2)
        return torch.distributions.MultivariateNormal(
            mean, scale_tril=cholesky(covariance), validate_args=False
        )

    def log_marginal_likelihood(self) -> Float[Tensor, "*batch"]:
        """Log p(targets) of the streaming model [*batch]: −½ log|A| + ½ bᵀA⁻¹b plus the data's own constant.

        Exact for the dense GP when nothing was projected, the FITC evidence on a fixed basis. Differentiable
        in the kernel's parameters, with the pseudo-likelihood of the basis held fixed.
        """
        gram_factor = cholesky(self._gram())
        precision, information = self._whiten(gram_factor)
        factor = cholesky(precision)
        half = _solve(factor, information.unsqueeze(-1))
        log_determinant = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self.evidence_constant + 0.5 * (half.square().sum((-2, -1)) - log_determinant)

    # ---------------------------------------------------------------- learning

    @torch.no_grad()
    def update(
        self,
        inputs: Float[Tensor, "*#batch N D"],
        targets: Float[Tensor, "*#batch N"],
        stamp: int | None = None,
        mask: Bool[Tensor, "*#batch N"] | None = None,
    ) -> None:
        """Bayes' rule on a block of data: grow the basis, absorb every point, prune to the budget.

        Args:
            inputs: [*batch, N, D].
            targets: noisy values of f [*batch, N].
            stamp: sets the clock, the time stamp of basis vectors added from now on.
            mask: which points count, [*batch, N]; the others leave no trace. All unless told.

        Raises:
            ValueError: wrong shapes, NaN or infinite data; nothing was changed then.
        """
        inputs, targets, mask = admit_data(inputs, targets, mask, self.batch_shape, self.basis)
        if stamp is not None:
            self.clock.fill_(stamp)
        block = 1 if self.order == "arrival" else BLOCK
        for start in range(0, inputs.shape[-2], block):
            stop = start + block
            self._absorb_block(inputs[..., start:stop, :], targets[..., start:stop], mask[..., start:stop])

    def _absorb_block(self, inputs: Tensor, targets: Tensor, mask: Tensor) -> None:
        noise = self.noise_variance.unsqueeze(-1)
        phi = self._features(inputs)
        prior = self.kernel.diag(inputs)
        novelty = prior - phi.square().sum(-2)
        floor = NOVELTY_FLOOR[prior.dtype] * prior
        threshold = torch.maximum((self.novelty_threshold * noise).expand_as(prior), floor)
        limit = self._additions_allowed(inputs.shape[-2])
        if bool(((novelty > threshold) & mask & (limit > 0).unsqueeze(-1)).any()):
            residual = self.kernel(inputs, inputs) - phi.mT @ phi
            selection = select_novel(residual, torch.where(mask, novelty, -torch.inf), threshold, limit)
            novelty = torch.where(mask, selection.novelty, novelty)
            phi = self._add(selection, inputs, phi)
        # moment: 1/(σ0² + ν); dtc ignores what the basis misses
        variance = noise + novelty if self.projection == "moment" else noise.expand_as(novelty)
        weight = torch.where(mask, 1 / variance, 0.0)
        scaled = phi * weight.sqrt().unsqueeze(-2)
        self.precision.add_(scaled @ scaled.mT)
        self.information.add_((phi * (weight * targets).unsqueeze(-2)).sum(-1))
        data_fit = weight * targets.square() - torch.where(mask, (weight / (2 * torch.pi)).log(), 0.0)
        self.evidence_constant.sub_(0.5 * data_fit.sum(-1))
        self.observations.add_(mask.sum(-1))
        self._stale = True
        if bool((self.size > self.capacity - min(self.overshoot, _churn(inputs.shape[-2]))).any()):
            self._prune()

    def _additions_allowed(self, points: int) -> Int[Tensor, "*batch"]:
        """Free growth up to the budget, then `_churn` per block, never past the buffers."""
        wanted = (self.budget - self.size).clamp_min(0) + _churn(points)
        return torch.minimum(wanted, self.capacity - self.size)

    def _add(self, selection: Selection, inputs: Tensor, phi: Tensor) -> Tensor:
        """Write the selected points behind the basis in use; returns Φ with its new rows."""
        slots = self.size.unsqueeze(-1) + torch.arange(selection.pivots.shape[-1], device=self.size.device)
        rows = torch.arange(self.capacity, device=self.size.device)
        place = (rows.unsqueeze(-1) == slots.unsqueeze(-2)) & selection.accepted.unsqueeze(-2)  # [*b, B, J]
        one_hot = place.to(phi.dtype)
        phi = phi + one_hot @ selection.rows
        index = selection.pivots.unsqueeze(-2).expand(*selection.pivots.shape[:-1], self.capacity, -1)
        new_rows = phi.gather(-1, index).mT  # row j of the new part of L is φ of its own point
        below = rows <= slots.unsqueeze(-1)  # and ends at the diagonal
        self.gram_factor.add_(one_hot @ (new_rows * below - one_hot.mT))
        chosen = inputs.gather(
            -2, selection.pivots.unsqueeze(-1).expand(*selection.pivots.shape, inputs.shape[-1])
        )
        self.basis.add_(one_hot @ chosen)
        self.stamps.copy_(torch.where(place.any(-1), self.clock, self.stamps))
        self.size.add_(selection.accepted.sum(-1))
        return phi

    def _prune(self) -> None:
        """Delete the lowest scores until every learner is back at its budget."""
        score = self.pruning(self.basis_statistics()).masked_fill(~self.mask, -torch.inf)
        ranked = score.argsort(dim=-1, descending=True)
        order = torch.cat([ranked[..., : self.budget].sort(-1).values, ranked[..., self.budget :]], -1)
        state = Whitened(self.gram_factor, self.precision, self.information)
        left, evidence = keep_first(state, order, self.budget, self.projection)
        basis = self.basis.gather(-2, order.unsqueeze(-1).expand_as(self.basis))[..., : self.budget, :]
        stamps = self.stamps.gather(-1, order)[..., : self.budget]
        self._clear()
        kept = slice(self.budget)
        self.basis[..., kept, :] = basis
        self.stamps[..., kept] = stamps
        self.gram_factor[..., kept, kept] = left.gram_factor
        self.precision[..., kept, kept] = left.precision
        self.information[..., kept] = left.information
        self.evidence_constant.add_(evidence)
        self.size.clamp_(max=self.budget)
        self._stale = True

    def basis_statistics(self) -> BasisStatistics:
        """What a pruning score sees of each basis vector, [*batch, capacity] each."""
        self.refresh()
        inverse_factor = self._inverse_gram_factor()
        half = _solve(self.precision_factor, inverse_factor)
        alpha = (inverse_factor * self.weights.unsqueeze(-1)).sum(-2)
        return BasisStatistics(
            alpha, inverse_factor.square().sum(-2), half.square().sum(-2), self.stamps, self.mask
        )

    @torch.no_grad()
    def merge(self, other: "SparseOnlineGP") -> None:
        """Add what `other`, a GP with the same kernel and the same basis, has learned: A += A' − I, b += b'.

        Raises:
            ValueError: the two bases differ.
        """
        if not (torch.equal(self.size, other.size) and torch.equal(self.basis, other.basis)):
            raise ValueError(
                f"merge needs one basis shared by both, got sizes {self.size.tolist()} and "
                f"{other.size.tolist()} with different vectors; start both from the same basis "
                "(load_state_dict), then update each"
            )
        self.precision.add_(other.precision)
        self.precision.diagonal(dim1=-2, dim2=-1).sub_(1)
        self.information.add_(other.information)
        self.evidence_constant.add_(other.evidence_constant)
        self.observations.add_(other.observations)
        self._stale = True

    @torch.no_grad()
    def rebase(self) -> None:
        """Take over the kernel's present parameters: call after changing them.

        The pseudo-likelihood of the basis values stays; prior, factors and posterior follow the new kernel.
        """
        gram_factor = cholesky(self._gram())
        precision, information = self._whiten(gram_factor)
        self.gram_factor.copy_(gram_factor)
        self.precision.copy_(precision)
        self.information.copy_(information)
        self._stale = True

    @torch.no_grad()
    def reset(self) -> None:
        """Forget all data and the basis; the kernel's parameters and the noise stay."""
        self._clear()
        self.size.zero_()
        self.clock.zero_()
        self.observations.zero_()
        self.evidence_constant.zero_()
        self._stale = True

    @torch.no_grad()
    def refresh(self) -> None:
        """Bring the derived factors up to date with the state; does nothing when they are."""
        if self._stale:
            self.precision_factor.copy_(cholesky(self.precision))
            self.weights.copy_(
                torch.cholesky_solve(self.information.unsqueeze(-1), self.precision_factor).squeeze(-1)
            )
            self._stale = False

    # ---------------------------------------------------------------- inside

    def _features(self, inputs: Tensor) -> Float[Tensor, "*batch B N"]:
        """φ = L⁻¹ k(X_B, x) in columns, zero in unused rows."""
        return _solve(self.gram_factor, self.kernel(self.basis, inputs) * self.mask.unsqueeze(-1))

    def _gram(self) -> Float[Tensor, "*batch B B"]:
        """K(X_B, X_B) with identity rows where unused, under the kernel's present parameters."""
        used = self.mask.unsqueeze(-1) & self.mask.unsqueeze(-2)
        eye = torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device)
        return torch.where(used, self.kernel(self.basis, self.basis), eye)

    def _whiten(self, gram_factor: Tensor) -> tuple[Tensor, Tensor]:
        """(A, b) of the same pseudo-likelihood in the coordinates of another Gram factor L' = L G."""
        change = _solve(self.gram_factor, gram_factor)  # G
        eye = torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device)
        precision = eye + change.mT @ (self.precision - eye) @ change  # I + L'ᵀΛL'
        return precision, (change * self.information.unsqueeze(-1)).sum(-2)  # L'ᵀh

    def _inverse_gram_factor(self) -> Float[Tensor, "*batch B B"]:
        eye = torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device)
        return _solve(self.gram_factor, eye.expand_as(self.gram_factor))

    def _clear(self) -> None:
        for matrix in (self.gram_factor, self.precision):
            matrix.zero_()
            matrix.diagonal(dim1=-2, dim2=-1).fill_(1)
        for other in (self.basis, self.information, self.stamps):
            other.zero_()

    def _forget_factors(self) -> None:
        self._stale = True


def _solve(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
    return torch.linalg.solve_triangular(factor, right, upper=upper)


def _churn(points: int) -> int:
    """Most additions to a full basis from one block."""
    return -(-points // CHURN)


def _check_options(
    budget: int, novelty_threshold: float, projection: str, order: str, overshoot: int | None
) -> None:
    if budget < 1:
        raise ValueError(f"budget must be at least 1 basis vector, got {budget}")
    if overshoot is not None and overshoot < 1:
        raise ValueError(f"overshoot must be at least 1 vector above the budget, got {overshoot}")
    if not novelty_threshold >= 0:
        raise ValueError(
            f"novelty_threshold must be at least 0 (times the noise variance), got {novelty_threshold}"
        )
    if projection not in ("moment", "dtc"):
        raise ValueError(f"projection must be 'moment' or 'dtc', got {projection!r}")
    if order not in ("novelty", "arrival"):
        raise ValueError(f"order must be 'novelty' or 'arrival', got {order!r}")
