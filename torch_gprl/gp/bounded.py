"""A basis that grows by what is new in the data and stays within a budget.

Additions by largest novelty in a block (see `selection`), freely up to the budget and a bounded number
afterwards; deletions in rounds, after a block has been learned, by a score (see `pruning`).
"""

from typing import Literal, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_gprl.gp.pruning import InformationScore, PruningScore, Whitened, basis_statistics, keep_first
from torch_gprl.gp.selection import Selection, select_novel
from torch_gprl.gp.whitened import NOVELTY_FLOOR, WhitenedState, squared_columns
from torch_gprl.kernels.base import Kernel

# A full basis admits at most one in so many points of a stream: every swap projects the past, but the points
# that came first need not be the best. On streams where every point is novel, one in 8 predicts better up to
# about 20 points a basis vector, one in 32 from about 40 on.
YOUNG_CHURN, CHURN = 8, 32
YOUTH = 20  # observations for each vector of the budget
# Additions to a full basis wait for each other, to be the most novel of one block: they predict better than
# as many that are each the most novel of a few points, and a basis that has changed costs like two blocks.
GROUP = 8


class BoundedBasis(WhitenedState):
    """The state of a sparse process whose basis is bounded; arguments as `SparseOnlineGP`."""

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

    def _grow(self, inputs: Tensor, mask: Tensor | None, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Add the novel points of a block to the basis; φ and novelty of all of them, on the new basis."""
        phi = self._features(inputs)
        prior = self.kernel.diag(inputs)
        novelty = prior - squared_columns(phi)
        threshold = torch.maximum(self.novelty_threshold * noise, NOVELTY_FLOOR[prior.dtype] * prior)
        candidate = novelty > threshold if mask is None else (novelty > threshold) & mask
        if not bool(candidate.any()):
            return phi, novelty
        # free growth up to the budget, then the churn, never past the buffers
        churn = self._churn(inputs.shape[-2] if mask is None else mask.sum(-1))
        limit = torch.minimum((self.budget - self.size).clamp_min(0) + churn, self.capacity - self.size)
        if not bool(limit.any()):
            return phi, novelty
        residual = self.kernel(inputs, inputs) - phi.mT @ phi
        open_to = novelty if mask is None else novelty.where(mask, -torch.inf)
        selection = select_novel(residual, open_to, threshold, limit)
        left = selection.novelty if mask is None else torch.where(mask, selection.novelty, novelty)
        return self._add(selection, inputs, phi), left

    def _add(self, selection: Selection, inputs: Tensor, phi: Tensor) -> Tensor:
        """Write the selected points behind the basis in use; returns Φ with its new rows."""
        picks, before = selection.pivots.shape[-1], phi.shape[-2]
        after = min(before + picks, self.capacity)
        wide = phi if after == before else pad(phi, (0, 0, 0, after - before))
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

    def _flat(self, name: str) -> Tensor:
        """A buffer with all batch dimensions as one, the same memory."""
        buffer = self.get_buffer(name)
        return buffer.view(-1, *buffer.shape[len(self.batch_shape) :])

    def _churn(self, points: int | Tensor) -> Tensor:
        """Most additions to a full basis from the next points, of each learner."""
        if self.order == "arrival":
            return torch.ones_like(self.observations)
        youth = YOUTH * self.budget
        seen = torch.stack([self.observations, self.observations + points])
        before, after = admissions(seen, seen.clamp_max(youth), youth, self._group(points))
        return after - before

    def _group(self, points: int | Tensor) -> int | Tensor:
        """How many additions to a full basis come at once, from a block of so many points."""
        largest = max(1, min(GROUP, self.overshoot // 6))
        return 1 + (largest - 1) * (points >= 2 * GROUP)

    def _room(self, points: int | Tensor) -> int | Tensor:
        """Rows kept free for the additions of a next block of so many points."""
        room = self._group(points) + -(-points // CHURN) - 1
        return room.clamp_max(self.overshoot) if isinstance(room, Tensor) else min(room, self.overshoot)

    def _prune(self, full: Tensor) -> None:
        """Delete the lowest scores of the learners that are `full` until they are back at their budget."""
        used = slice(int(self.size.max()))
        chosen = slice(None) if bool(full.all()) else full.reshape(-1).nonzero().squeeze(-1)
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


Count = TypeVar("Count", int, Tensor)


def admissions(observations: Count, young: Count, youth: int, group: Count | int) -> Count:
    """How many points, the first `young` in its youth, a basis that was always full has admitted at most."""
    early, late = young // YOUNG_CHURN, (observations - young) // CHURN
    return early - early % group * (young < youth) + late - late % group


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
