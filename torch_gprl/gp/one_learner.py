"""How one learner on the CPU learns from plain regression data: as many do, in a third of the time.

The numbers that decide (how many rows are in use, which point is the most novel) live on the host, matrices
are views of the rows in use, and nothing is masked.
"""

import math

import numpy as np
import torch
from torch import Tensor

from torch_gprl.gp.bounded import YOUTH, BoundedBasis, admissions
from torch_gprl.gp.observed import Observed
from torch_gprl.gp.one_point import InUse
from torch_gprl.gp.whitened import NOVELTY_FLOOR

LOG_TWO_PI = math.log(2 * math.pi)
PerPoint = float | np.ndarray  # the same for all points of a block, or one for each
LARGE = 128  # rows and points from which a matrix product in parts is faster


def absorb(gp: BoundedBasis, block: Observed, noise_variance: float) -> None:
    """Bayes' rule on a block of plain data: grow the basis, absorb every point, prune to the budget."""
    points = block.inputs.shape[-2]
    learn = _absorb_point if points == 1 else _absorb_block
    rows = learn(gp, block.inputs, block.targets.detach().numpy().reshape(-1), noise_variance)
    if not gp._stale:
        gp._stale = True
    if rows > gp.capacity - int(gp._room(points)):
        gp._prune(gp.size == rows)


def _absorb_block(gp: BoundedBasis, inputs: Tensor, targets: np.ndarray, noise_variance: float) -> int:
    """The rows in use afterwards."""
    used = InUse.of(gp)
    phi, prior = used.features(inputs), used.prior
    if prior is None:
        prior = gp.kernel.diag(inputs).numpy().reshape(-1)
    novelty = prior - np.square(torch.linalg.vector_norm(phi, dim=0).numpy())
    threshold = np.maximum(gp.novelty_threshold * noise_variance, NOVELTY_FLOOR[phi.dtype] * prior)
    if (novelty - threshold).max() > 0 and (most := _most_additions(gp, used, len(novelty))):
        phi = _add_most_novel(gp, inputs, phi, novelty, threshold, most)
        used = InUse.of(gp)
    # moment: W = 1/(σ0² + ν); dtc ignores what the basis misses
    variance = (novelty if gp.projection == "moment" else np.zeros_like(novelty)) + noise_variance
    scale = 1 / np.sqrt(variance)
    phi.mul_(torch.from_numpy(scale))
    targets = targets * scale
    _add_gram(used.precision, phi)  # A += Φ W Φᵀ
    used.information.addmv_(phi, torch.from_numpy(targets))  # b += Φ W y
    log_density = np.log(variance).sum() + targets.dot(targets) + len(targets) * LOG_TWO_PI
    used.evidence[0] -= 0.5 * log_density
    used.observations[0] += len(targets)
    return len(phi)


def _absorb_point(gp: BoundedBasis, point: Tensor, target: np.ndarray, noise_variance: float) -> int:
    """`_absorb_block` for one point, in NumPy, whose calls cost a third."""
    used = InUse.of(gp)
    phi = used.explain(used.covary(point.detach().numpy().reshape(-1)))
    prior = used.prior_at(gp, point)
    novelty = prior - float(phi.dot(phi))
    threshold = max(gp.novelty_threshold * noise_variance, NOVELTY_FLOOR[point.dtype] * prior)
    if novelty > threshold and _most_additions(gp, used, 1):
        phi = np.append(phi, np.asarray(math.sqrt(novelty), phi.dtype))
        _append(gp, len(phi) - 1, torch.from_numpy(phi).unsqueeze(0), point)
        used, novelty = InUse.of(gp), 0.0
    weight = 1 / (noise_variance + novelty) if gp.projection == "moment" else 1 / noise_variance
    observed, column = float(target[0]), torch.from_numpy(phi)
    used.precision.addmm_(column.unsqueeze(1), column.unsqueeze(0), alpha=weight)  # A += φ w φᵀ
    used.information.add_(column, alpha=weight * observed)  # b += φ w y
    used.evidence[0] += 0.5 * (math.log(weight) - weight * observed**2 - LOG_TWO_PI)
    used.observations[0] += 1
    return len(phi)


def _most_additions(gp: BoundedBasis, used: InUse, points: int) -> int:
    """Free growth up to the budget, then the churn, never past the buffers."""
    rows, before, youth = used.active.rows, int(used.observations[0]), YOUTH * gp.budget
    after = before + points
    group, churn = int(gp._group(points)), 1
    if gp.order == "novelty":
        churn = admissions(after, min(after, youth), youth, group)
        churn -= admissions(before, min(before, youth), youth, group)
    return min(max(gp.budget - rows, 0) + churn, gp.capacity - rows, points)


def _add_most_novel(
    gp: BoundedBasis, inputs: Tensor, phi: Tensor, novelty: np.ndarray, threshold: PerPoint, most: int
) -> Tensor:
    """Partially pivoted Cholesky of what the basis misses: one row of L, and of Φ, for each point picked.

    Returns Φ with the new rows; what is missed, `novelty`, is updated.
    """
    before = rows = len(phi)
    features = np.empty((len(novelty), before + most), novelty.dtype)  # Φᵀ
    features[:, :before] = phi.mT.numpy()
    covariance, pivots = _only(gp.kernel(inputs, inputs), 2).numpy(), list[int]()
    while rows < before + most:
        excess = novelty - threshold
        pivot = int(excess.argmax())
        if excess[pivot] <= 0:
            break
        row = covariance[pivot] - features[:, :rows] @ features[pivot, :rows]
        row /= math.sqrt(row[pivot])
        features[:, rows] = row
        novelty -= row * row
        novelty[pivot] = 0.0  # nothing is missed of a basis vector
        pivots.append(pivot)
        rows += 1
    known, picked = torch.from_numpy(features)[:, :rows], torch.tensor(pivots)
    _append(gp, before, known[picked].tril_(before), _only(inputs, 2)[picked])
    return known.mT


def _append(gp: BoundedBasis, before: int, gram_rows: Tensor, points: Tensor) -> None:
    """Write new basis vectors, and their rows of L [J, before + J], behind those in use."""
    after = before + len(points)
    _only(gp.gram_factor, 2)[before:after, :after] = gram_rows
    _only(gp.basis, 2)[before:after] = points
    _only(gp.stamps, 1)[before:after] = gp.clock
    gp.size.fill_(after)


def _add_gram(matrix: Tensor, columns: Tensor) -> None:
    """M += C Cᵀ; of a large product, which is symmetric, a quarter is copied."""
    rows = len(columns)
    top = rows // 2 if min(columns.shape) >= LARGE else rows
    matrix[:top, :top].addmm_(columns[:top], columns[:top].mT)
    if top < rows:
        matrix[top:].addmm_(columns[top:], columns.mT)
        matrix[:top, top:] = matrix[top:, :top].mT


def _only(tensor: Tensor, dims: int) -> Tensor:
    """The last `dims` dimensions of a tensor whose others have size 1."""
    return tensor if tensor.ndim == dims else tensor.reshape(tensor.shape[tensor.ndim - dims :])
