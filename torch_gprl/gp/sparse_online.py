"""The sparse online Gaussian process: Bayes' rule on blocks of data, with a bounded basis.

Absorbing a block adds Φ W Φᵀ to A and Φ W y to b (see `whitened`): one matrix product, whatever the order of
the data, and learners with one basis merge by adding. Sources: Csató and Opper (2002), "Sparse on-line
Gaussian processes"; the thesis' equations (.5) to (.13); Engel, Mannor and Meir (2005) for temporal
differences. The textbook recursion in α, C and K⁻¹, which loses its digits, is `RecursiveGP`.
"""

import math
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torch_gprl.gp.door import admit_data, refuse_non_finite
from torch_gprl.gp.pruning import InformationScore, PruningScore, Whitened, basis_statistics, keep_first
from torch_gprl.gp.selection import Selection, select_novel
from torch_gprl.gp.whitened import NOVELTY_FLOOR, WhitenedState, solve_triangular
from torch_gprl.kernels.base import Kernel
from torch_gprl.kernels.gaussian_inputs import GaussianInputs

BLOCK = 256  # points absorbed at once; longer updates are cut into blocks of this size
# A full basis admits at most one in so many points of a stream: every swap projects the past, but the points
# that came first need not be the best. On streams where every point is novel, one in 8 predicts better up to
# about 20 points a basis vector, one in 32 from about 40 on.
YOUNG_CHURN, CHURN = 8, 32
YOUTH = 20  # observations for each vector of the budget


class Observed(NamedTuple):
    """A block of linear observations y = f(x) − γ f(x') + noise; the second term for transitions only."""

    inputs: Float[Tensor, "*batch N D"]
    targets: Float[Tensor, "*batch N"]
    mask: Bool[Tensor, "*batch N"] | None
    next_inputs: GaussianInputs | None
    discount: Float[Tensor, "*batch N"] | None

    def block(self, start: int, stop: int) -> "Observed":
        """The points from `start` to `stop`."""
        chosen = slice(start, stop)
        following = self.next_inputs
        return Observed(
            self.inputs[..., chosen, :],
            self.targets[..., chosen],
            None if self.mask is None else self.mask[..., chosen],
            following
            and GaussianInputs(
                following.mean[..., chosen, :], following.variance[..., chosen, :], following.columns
            ),
            None if self.discount is None else self.discount[..., chosen],
        )


class SparseOnlineGP(WhitenedState):
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
            admit one in 8 points of a young stream and one in 32 later on; `"arrival"` takes the points one
            by one and admits every novel one, as the textbook recursion does.
        overshoot: vectors above the budget that may gather before a round of pruning takes them at once;
            min(budget / 4, 64) unless told. 1 prunes after every addition.

    Raises:
        ValueError: an option out of its range; the message says which and what would be valid.
    """

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
        _check_options(budget, novelty_threshold, projection, order, overshoot)
        overshoot = max(1, min(budget // 4, 64)) if overshoot is None else overshoot
        shape = torch.Size(kernel.batch_shape if batch_shape is None else batch_shape)
        super().__init__(kernel, budget + overshoot, noise_variance, shape)
        self.budget = budget
        self.overshoot = overshoot
        self.novelty_threshold = novelty_threshold
        self.pruning = InformationScore() if pruning is None else pruning
        self.projection: Literal["moment", "dtc"] = projection
        self.order: Literal["novelty", "arrival"] = order

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
        points, noise = inputs.shape[-2], self.noise_variance.unsqueeze(-1)
        block = 1 if self.order == "arrival" else BLOCK
        plain = mask is None and next_inputs is None and inputs.ndim == 2 and inputs.device.type == "cpu"
        if plain and min(points, block) == 1:
            for point, target in zip(inputs.split(1), targets.tolist(), strict=True):
                self._absorb_point(point, target, float(noise))
            return
        for start in range(0, points, block):
            self._absorb_block(observed.block(start, start + block), noise)

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
        if not isinstance(next_inputs, GaussianInputs):
            next_inputs = GaussianInputs.exactly(next_inputs)
        rate = torch.as_tensor(discount, dtype=targets.dtype, device=targets.device)
        # a point that does not count, or has no successor, may hold anything there
        rate = rate.expand(targets.shape)
        counts = rate != 0 if mask is None else mask & (rate != 0)
        mean, rate, _ = admit_data(next_inputs.mean, rate, counts, self.batch_shape, self.basis)
        variance = next_inputs.variance.to(mean.dtype).expand(*mean.shape[:-1], -1)
        variance = torch.where(counts.unsqueeze(-1), variance, 0.0)
        refuse_non_finite("variance of next_inputs", variance)
        return Observed(inputs, targets, mask, GaussianInputs(mean, variance, next_inputs.columns), rate)

    def _absorb_block(self, block: Observed, noise: Tensor) -> None:
        phi, novelty = self._grow(block.inputs, block.mask, noise)
        if block.next_inputs is not None and block.discount is not None:
            phi, novelty = self._difference(phi, block.inputs, block.next_inputs, block.discount)
        # moment: W = 1/(σ0² + ν); dtc ignores what the basis misses
        variance = noise + novelty if self.projection == "moment" else noise.expand_as(novelty)
        self._accumulate(phi, variance, block.targets, block.mask)
        # room for the additions of a next block like this one, by the points that count
        points = block.targets.shape[-1] if block.mask is None else block.mask.sum(-1).clamp_min(1)
        room = torch.as_tensor(-(-points // CHURN), device=self.size.device).clamp_max(self.overshoot)
        full = self.size > self.capacity - room
        if bool(full.any()):
            self._prune(full)

    def _absorb_point(self, point: Tensor, target: float, noise: float) -> None:
        """`_absorb_block` for one point of one learner on the CPU, with host numbers: three times as fast."""
        active = self._active()
        phi = solve_triangular(active.gram_factor, active.cross(point))
        prior = float(self.kernel.diag(point))
        novelty, rows = prior - float(phi.mT @ phi), active.rows
        floor = NOVELTY_FLOOR[phi.dtype] * prior
        novel = novelty > max(self.novelty_threshold * noise, floor)
        if novel and (rows < self.budget or int(self._churn(None, 1))):
            phi = torch.cat([phi, phi.new_full((1, 1), math.sqrt(novelty))])
            self._append(phi.mT, point, rows)
            novelty, rows = 0.0, rows + 1
        weight = 1 / (noise + novelty) if self.projection == "moment" else 1 / noise
        self.precision[:rows, :rows].addmm_(phi, phi.mT, alpha=weight)
        self.information[:rows].add_(phi[:, 0], alpha=weight * target)
        self.evidence_constant.add_(0.5 * (math.log(weight) - weight * target**2 - LOG_TWO_PI))
        self.observations.add_(1)
        self._stale = True
        if rows == self.capacity:
            self._prune(self.size == rows)

    def _accumulate(self, phi: Tensor, variance: Tensor, targets: Tensor, mask: Tensor | None) -> None:
        """A += Φ W Φᵀ, b += Φ W y, and the constant of the evidence, with W = 1/variance."""
        weight, count = variance.reciprocal(), targets.shape[-1]
        log_weight = weight.log()
        if mask is not None:
            weight, log_weight, count = weight * mask, log_weight * mask, mask.sum(-1)
        scaled = phi * weight.sqrt().unsqueeze(-2)
        weighted = weight * targets
        precision = self.precision[..., : phi.shape[-2], : phi.shape[-2]]
        add_product = {2: precision.addmm_, 3: precision.baddbmm_}.get(phi.ndim)
        if add_product is None:
            precision.add_(scaled @ scaled.mT)
        else:
            add_product(scaled, scaled.mT)
        self.information[..., : phi.shape[-2]].add_((phi @ weighted.unsqueeze(-1)).squeeze(-1))
        quadratic = torch.linalg.vecdot(weighted, targets)
        self.evidence_constant.add_(0.5 * (log_weight.sum(-1) - quadratic - count * LOG_TWO_PI))
        self.observations.add_(count)
        self._stale = True

    def _grow(self, inputs: Tensor, mask: Tensor | None, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Add the novel points of a block to the basis; φ and novelty of all of them, on the new basis."""
        phi = self._features(inputs)
        prior = self.kernel.diag(inputs)
        novelty = prior - torch.linalg.vecdot(phi, phi, dim=-2)
        threshold = torch.maximum(self.novelty_threshold * noise, NOVELTY_FLOOR[prior.dtype] * prior)
        candidate = novelty > threshold if mask is None else (novelty > threshold) & mask
        if not bool(candidate.any()):
            return phi, novelty
        # free growth up to the budget, then the churn, never past the buffers
        wanted = (self.budget - self.size).clamp_min(0) + self._churn(mask, inputs.shape[-2])
        limit = torch.minimum(wanted, self.capacity - self.size)
        residual = self.kernel(inputs, inputs) - phi.mT @ phi
        open_to = novelty if mask is None else novelty.where(mask, -torch.inf)
        selection = select_novel(residual, open_to, threshold, limit)
        left = selection.novelty if mask is None else torch.where(mask, selection.novelty, novelty)
        return self._add(selection, inputs, phi), left

    def _add(self, selection: Selection, inputs: Tensor, phi: Tensor) -> Tensor:
        """Write the selected points behind the basis in use; returns Φ with its new rows."""
        picks, before = selection.pivots.shape[-1], phi.shape[-2]
        if phi.ndim == 2 and phi.device.type == "cpu":  # one learner, its size known: slices, thrice as fast
            phi = torch.cat([phi, selection.rows])
            self._append(phi[:, selection.pivots].mT.tril(before), inputs[selection.pivots], before)
            return phi
        after = min(before + picks, self.capacity)
        wide = pad(phi, (0, 0, 0, after - before))
        if not picks:
            return wide
        learner, pick = selection.accepted.reshape(-1, picks).nonzero(as_tuple=True)
        pivot = selection.pivots.reshape(-1, picks)[learner, pick]
        slot = self._flat("size")[learner] + pick
        flat = wide.view(-1, *wide.shape[-2:])
        flat[learner, slot] = selection.rows.reshape(-1, *selection.rows.shape[-2:])[learner, pick]
        # the new row of L is φ of the point itself, up to the diagonal
        below = torch.arange(after, device=phi.device) <= slot.unsqueeze(-1)
        self._flat("gram_factor")[learner, slot, :after] = flat[learner, :, pivot] * below
        self._flat("basis")[learner, slot] = inputs.reshape(-1, *inputs.shape[-2:])[learner, pivot]
        self._flat("stamps")[learner, slot] = self.clock
        self.size.add_(selection.accepted.sum(-1))
        return wide

    def _append(self, gram_rows: Tensor, points: Tensor, before: int) -> None:
        """Write new basis vectors of the only learner: their rows of L, [J, before + J], and themselves."""
        after = before + len(points)
        self.gram_factor[before:after, :after] = gram_rows
        self.basis[before:after] = points
        self.stamps[before:after] = self.clock
        self.size.fill_(after)

    def _flat(self, name: str) -> Tensor:
        """A buffer with all batch dimensions as one, the same memory."""
        buffer = self.get_buffer(name)
        return buffer.view(-1, *buffer.shape[len(self.batch_shape) :])

    def _difference(
        self, phi: Tensor, inputs: Tensor, following: GaussianInputs, discount: Tensor
    ) -> tuple[Tensor, Tensor]:
        """φ and novelty of f(x) − γ f(x'), from φ of x."""
        averaged = self._features(following)
        # the picks of small learners may have left rows of φ that no learner uses
        difference = phi[..., : averaged.shape[-2], :] - discount.unsqueeze(-2) * averaged
        shared = self.kernel.expected_pairs(following, GaussianInputs.exactly(inputs))
        own = self._prior_variance(following)
        # Var[f(x) − γ f(x')] = k(x, x) − 2γ k(x, x') + γ² k(x', x')
        prior = self.kernel.diag(inputs) - 2 * discount * shared + discount.square() * own
        return difference, prior - torch.linalg.vecdot(difference, difference, dim=-2)

    def _churn(self, mask: Tensor | None, points: int | Tensor) -> Tensor:
        """Most additions to a full basis from the next block, of each learner."""
        if self.order == "arrival":
            return torch.ones_like(self.observations)
        before = self.observations
        return self._admissions(before + (points if mask is None else mask.sum(-1))) - self._admissions(
            before
        )

    def _admissions(self, observations: Tensor) -> Tensor:
        """How many points a basis that was always full has admitted at most after so many observations."""
        youth = YOUTH * self.budget
        return observations.clamp_max(youth) // YOUNG_CHURN + (observations - youth).clamp_min(0) // CHURN

    def _prune(self, full: Tensor) -> None:
        """Delete the lowest scores of the learners that are `full` until they are back at their budget."""
        chosen, used = full.reshape(-1).nonzero().squeeze(-1), slice(self._active().rows)
        state = Whitened(
            self._flat("gram_factor")[chosen, used, used],
            self._flat("precision")[chosen, used, used],
            self._flat("information")[chosen, used],
        )
        basis, stamps = self._flat("basis")[chosen, used], self._flat("stamps")[chosen, used]
        mask = self.mask.view(-1, self.capacity)[chosen, used]
        score = self.pruning(basis_statistics(state, stamps, mask)).masked_fill(~mask, -torch.inf)
        ranked = score.argsort(dim=-1, descending=True)
        kept = ranked[:, : self.budget].sort(-1).values
        order = torch.cat([kept, ranked[:, self.budget :]], -1)
        left, evidence = keep_first(state, order, self.budget, self.projection)
        unused = self.capacity - self.budget
        wide = kept.unsqueeze(-1).expand(*kept.shape, basis.shape[-1])
        self._flat("basis")[chosen] = pad(basis.gather(1, wide), (0, 0, 0, unused))
        self._flat("stamps")[chosen] = pad(stamps.gather(1, kept), (0, unused))
        self._flat("gram_factor")[chosen] = _bordered(left.gram_factor, unused)
        self._flat("precision")[chosen] = _bordered(left.precision, unused)
        self._flat("information")[chosen] = pad(left.information, (0, unused))
        self._flat("evidence_constant")[chosen] += evidence
        self._flat("size")[chosen] = self.budget
        self._stale = True

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


def _bordered(matrix: Tensor, rows: int) -> Tensor:
    """The matrix with `rows` rows and columns of an identity behind it."""
    bordered = pad(matrix, (0, rows, 0, rows))
    bordered.diagonal(dim1=-2, dim2=-1)[..., matrix.shape[-1] :] = 1
    return bordered


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
