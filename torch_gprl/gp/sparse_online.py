"""The sparse online Gaussian process: Bayes' rule on blocks of data, with a bounded basis.

Absorbing a block adds Φ W Φᵀ to A and Φ W y to b (see `whitened`): one matrix product, whatever the order of
the data, and learners with one basis merge by adding. Sources: Csató and Opper (2002), "Sparse on-line
Gaussian processes"; the thesis' equations (.5) to (.13); Engel, Mannor and Meir (2005) for temporal
differences. The textbook recursion in α, C and K⁻¹, which loses its digits, is `RecursiveGP`.
"""

import math
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torch_gprl.gp import one_learner, one_point
from torch_gprl.gp.bounded import BoundedBasis
from torch_gprl.gp.door import admit_data, admit_inputs, admit_successors
from torch_gprl.gp.observed import Observed
from torch_gprl.gp.posterior import Posterior
from torch_gprl.kernels.gaussian_inputs import GaussianInputs

BLOCK = 256  # points absorbed at once; longer updates are cut into blocks of this size


class SparseOnlineGP(BoundedBasis):
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
        order: `"novelty"` picks new basis vectors from a block by largest novelty, and lets a full basis
            admit one in 8 points of a young stream and one in 32 later on, in groups; `"arrival"` takes the
            points one by one and admits every novel one, as the textbook recursion does.
        overshoot: vectors above the budget that may gather before a round of pruning takes them at once;
            min(budget / 4, 64) unless told. 1 prunes after every addition.

    Raises:
        ValueError: an option out of its range; the message says which and what would be valid.
    """

    @torch.no_grad()
    def update(
        self,
        inputs: Float[Tensor, "*#batch N D"],
        targets: Float[Tensor, "*#batch N"],
        stamp: int | None = None,
        mask: Bool[Tensor, "*#batch N"] | None = None,
        *,
        next_inputs: Float[Tensor, "*#batch N D"] | GaussianInputs | None = None,
        discount: float | Float[Tensor, "*#batch N"] = 1.0,
    ) -> None:
        """Bayes' rule on a block of data: grow the basis, absorb every point, prune to the budget.

        With `next_inputs` each target is a temporal difference, y = f(x) − γ f(x') + noise: with rewards as
        targets this is GPTD. A `GaussianInputs` averages f(x') over its Gaussian columns, in closed form.

        Args:
            inputs: [*batch, N, D].
            targets: noisy values of f, or of the difference, [*batch, N].
            stamp: sets the clock, the time stamp of basis vectors added from now on.
            mask: which points count, [*batch, N]; the others leave no trace. All unless told.
            next_inputs: x', [*batch, N, D]; none for plain regression.
            discount: γ, a number or [*batch, N]: 0 where x is the last point before a terminal state.

        Raises:
            ValueError: wrong shapes, NaN or infinite data; nothing was changed then.
        """
        inputs, targets, mask = admit_data(inputs, targets, mask, self.batch_shape, self.basis)
        observed = self._observed(inputs, targets, mask, next_inputs, discount)
        if stamp is not None:
            self.clock.fill_(stamp)
        if self._kernel_versions() != self._kernel_seen:
            self.rebase()
        if mask is None and next_inputs is None and self._is_alone():
            absorb = partial(one_learner.absorb, self, noise_variance=math.exp(self.log_noise_variance))
        else:
            absorb = partial(self._absorb_block, noise=self.noise_variance.unsqueeze(-1))
        points, block = inputs.shape[-2], 1 if self.order == "arrival" else BLOCK
        for start in range(0, points, block):
            absorb(observed if points <= block else observed.block(start, start + block))

    def posterior(self, inputs: Float[Tensor, "*#batch N D"] | GaussianInputs) -> Posterior:
        """Mean and variance of f (without noise), as told at `WhitenedState.posterior`."""
        if isinstance(inputs, Tensor) and inputs.shape[-2:-1] == (1,) and self._goes_short_way(inputs):
            return one_point.posterior(self, admit_inputs(inputs, self.batch_shape, self.basis))
        return super().posterior(inputs)

    def _goes_short_way(self, inputs: Tensor) -> bool:
        if torch.compiler.is_compiling() or not self._is_alone():
            return False
        tensors = (inputs, *self._kernel_tensors) if torch.is_grad_enabled() else ()
        return not any(tensor.requires_grad for tensor in tensors)

    def _observed(
        self,
        inputs: Tensor,
        targets: Tensor,
        mask: Tensor | None,
        next_inputs: Tensor | GaussianInputs | None,
        discount: float | Tensor,
    ) -> Observed:
        if next_inputs is None:
            return Observed(inputs, targets, mask, None, None)
        successors = admit_successors(next_inputs, discount, mask, inputs.shape[:-1], self.basis)
        return Observed(inputs, targets, mask, *successors)

    def _absorb_block(self, block: Observed, noise: Tensor) -> None:
        phi, novelty = self._grow(block.inputs, block.mask, noise)
        if block.next_inputs is not None and block.discount is not None:
            phi, novelty = self._difference(phi, block.inputs, block.next_inputs, block.discount)
        # moment: W = 1/(σ0² + ν); dtc ignores what the basis misses
        variance = noise + novelty if self.projection == "moment" else noise.expand_as(novelty)
        self._accumulate(phi, variance, block.targets, block.mask)
        points = block.targets.shape[-1] if block.mask is None else block.mask.sum(-1)
        full = self.size > self.capacity - self._room(points)
        if bool(full.any()):
            self._prune(full)

    def _accumulate(self, phi: Tensor, variance: Tensor, targets: Tensor, mask: Tensor | None) -> None:
        """A += Φ W Φᵀ, b += Φ W y, and the constant of the evidence, with W = 1/variance; overwrites Φ."""
        weight, count = variance.reciprocal(), targets.shape[-1]
        log_weight = weight.log()
        if mask is not None:
            weight, log_weight, count = weight * mask, log_weight * mask, mask.sum(-1)
        scale = weight.sqrt()
        scaled, observed = phi.mul_(scale.unsqueeze(-2)), scale * targets
        precision = self.precision[..., : phi.shape[-2], : phi.shape[-2]]
        add_product = {2: precision.addmm_, 3: precision.baddbmm_}.get(phi.ndim)
        if add_product is None:
            precision.add_(scaled @ scaled.mT)
        else:
            add_product(scaled, scaled.mT)
        self.information[..., : phi.shape[-2]].add_((observed.unsqueeze(-2) @ scaled.mT).squeeze(-2))
        quadratic = torch.linalg.vecdot(observed, observed)
        self.evidence_constant.add_(0.5 * (log_weight.sum(-1) - quadratic - count * LOG_TWO_PI))
        self.observations.add_(count)
        self._stale = True

    def _difference(
        self, phi: Tensor, inputs: Tensor, following: GaussianInputs, discount: Tensor
    ) -> tuple[Tensor, Tensor]:
        """φ and novelty of f(x) − γ f(x'), from φ of x."""
        averaged = self._features(following)
        # rows that no learner uses are zero, and may be more or fewer in φ
        same_rows = pad(phi, (0, 0, 0, averaged.shape[-2] - phi.shape[-2]))
        difference = same_rows - discount.unsqueeze(-2) * averaged
        shared = self.kernel.expected_pairs(following, GaussianInputs.exactly(inputs))
        own = self._prior_variance(following)
        # Var[f(x) − γ f(x')] = k(x, x) − 2γ k(x, x') + γ² k(x', x')
        prior = self.kernel.diag(inputs) - 2 * discount * shared + discount.square() * own
        return difference, prior - torch.linalg.vecdot(difference, difference, dim=-2)

    @torch.no_grad()
    def merge(self, other: "SparseOnlineGP") -> None:
        """Add what `other`, a GP with the same kernel and the same basis, has learned: A += A' − I, b += b'.

        What both have learned counts twice. To share out data, give every part the basis and `forget` there
        what it was made from.

        Raises:
            ValueError: the two bases differ.
        """
        if not (torch.equal(self.size, other.size) and torch.equal(self.basis, other.basis)):
            raise ValueError(
                f"merge needs one basis shared by both, got sizes {self.size.tolist()} and "
                f"{other.size.tolist()} with different vectors; start from one basis (load_state_dict, then "
                "forget in all but one), and learn without adding to it"
            )
        self.precision.add_(other.precision)
        self.precision.diagonal(dim1=-2, dim2=-1).sub_(1)
        self.information.add_(other.information)
        self.evidence_constant.add_(other.evidence_constant)
        self.observations.add_(other.observations)
        self._stale = True

    @torch.no_grad()
    def reset(self) -> None:
        """Forget all data and the basis; the kernel's parameters and the noise stay."""
        self.forget()
        self.gram_factor.copy_(torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device))
        for other in (self.basis, self.stamps, self.size, self.clock):
            other.zero_()
        self._accept_state()

    @torch.no_grad()
    def forget(self) -> None:
        """Forget all data but keep the basis: the prior again, ready for other data or other targets."""
        self.precision.copy_(torch.eye(self.capacity, dtype=self.basis.dtype, device=self.basis.device))
        for other in (self.information, self.evidence_constant, self.observations):
            other.zero_()
        self._stale = True


LOG_TWO_PI = math.log(2 * math.pi)
