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
from torch_gprl.gp.whitened import NOVELTY_FLOOR, squared_columns

LOG_TWO_PI = math.log(2 * math.pi)
LARGE = 128  # rows and points from which a matrix product in parts is faster


def absorb(gp: BoundedBasis, block: Observed, noise_variance: float) -> None:
    """Bayes' rule on a block of plain data: grow the basis, absorb every point, prune to the budget."""
    inputs, targets = _only(block.inputs, 2), _only(block.targets, 1)
    points = len(inputs)
    learn = _absorb_point if points == 1 else _absorb_block
    rows = learn(gp, inputs, targets, noise_variance)
    if not gp._stale:
        gp._stale = True
    if rows > gp.capacity - int(gp._room(points)):
        gp._prune(gp.size == rows)


def _absorb_block(gp: BoundedBasis, inputs: Tensor, targets: Tensor, noise_variance: float) -> int:
    """The rows in use afterwards."""
    used = InUse.of(gp)
    phi, prior = used.features(inputs), used.prior
    if prior is None:
        prior = _only(gp.kernel.diag(inputs), 1)
    novelty = squared_columns(phi).neg_().add_(prior)
    threshold = _at_least(gp.novelty_threshold * noise_variance, prior * NOVELTY_FLOOR[phi.dtype])
    if float((novelty - threshold).amax()) > 0 and (most := _most_additions(gp, len(phi), len(inputs))):
        phi, novelty = _add_most_novel(gp, inputs, phi, novelty, threshold, most)
        used = InUse.of(gp)
    # moment: W = 1/(σ0² + ν); dtc ignores what the basis misses
    variance = novelty.add_(noise_variance) if gp.projection == "moment" else novelty.fill_(noise_variance)
    scale = variance.rsqrt()
    phi, targets = phi.mul_(scale), targets * scale
    _add_gram(used.precision, phi)  # A += Φ W Φᵀ
    used.information.add_(phi.mv(targets))  # b += Φ W y
    log_density = float(variance.log_().sum()) + float(targets.dot(targets)) + len(inputs) * LOG_TWO_PI
    used.evidence[0] -= 0.5 * log_density
    used.observations[0] += len(inputs)
    return len(phi)


def _absorb_point(gp: BoundedBasis, point: Tensor, target: Tensor, noise_variance: float) -> int:
    """`_absorb_block` for one point, in NumPy, whose calls cost a third."""
    used = InUse.of(gp)
    phi = used.explain(used.covary(point.detach().numpy()[0]))
    prior = used.prior_at(gp, point)
    novelty = prior - float(phi.dot(phi))
    threshold = max(gp.novelty_threshold * noise_variance, NOVELTY_FLOOR[point.dtype] * prior)
    if novelty > threshold and _most_additions(gp, len(phi), 1):
        phi = np.append(phi, np.asarray(math.sqrt(novelty), phi.dtype))
        _append(gp, len(phi) - 1, torch.from_numpy(phi).unsqueeze(0), point)
        used, novelty = InUse.of(gp), 0.0
    weight = 1 / (noise_variance + novelty) if gp.projection == "moment" else 1 / noise_variance
    observed, column = float(target), torch.from_numpy(phi)
    used.precision.addmm_(column.unsqueeze(1), column.unsqueeze(0), alpha=weight)  # A += φ w φᵀ
    used.information.add_(column, alpha=weight * observed)  # b += φ w y
    used.evidence[0] += 0.5 * (math.log(weight) - weight * observed**2 - LOG_TWO_PI)
    used.observations[0] += 1
    return len(phi)


def _at_least(least: float, values: float | Tensor) -> float | Tensor:
    return values.clamp_min(least) if isinstance(values, Tensor) else max(values, least)


def _most_additions(gp: BoundedBasis, rows: int, points: int) -> int:
    """Free growth up to the budget, then the churn, never past the buffers."""
    before, youth = int(gp.observations), YOUTH * gp.budget
    after = before + points
    group, churn = int(gp._group(points)), 1
    if gp.order == "novelty":
        churn = admissions(after, min(after, youth), youth, group)
        churn -= admissions(before, min(before, youth), youth, group)
    return min(max(gp.budget - rows, 0) + churn, gp.capacity - rows, points)


def _add_most_novel(
    gp: BoundedBasis, inputs: Tensor, phi: Tensor, novelty: Tensor, threshold: float | Tensor, most: int
) -> tuple[Tensor, Tensor]:
    """Partially pivoted Cholesky of what the basis misses: one row of L, and of Φ, for each point picked."""
    before = rows = len(phi)
    features = np.empty((len(inputs), before + most), novelty.numpy().dtype)  # Φᵀ
    features[:, :before] = phi.mT.numpy()
    covariance, pivots = _only(gp.kernel(inputs, inputs), 2).numpy(), list[int]()
    missed, least = novelty.numpy(), threshold.numpy() if isinstance(threshold, Tensor) else threshold
    while rows < before + most:
        excess = missed - least
        pivot = int(excess.argmax())
        if excess[pivot] <= 0:
            break
        row = covariance[pivot] - features[:, :rows] @ features[pivot, :rows]
        row /= math.sqrt(row[pivot])
        features[:, rows] = row
        missed -= row * row
        missed[pivot] = 0.0  # nothing is missed of a basis vector
        pivots.append(pivot)
        rows += 1
    known = torch.from_numpy(features)[:, :rows]
    _append(gp, before, known[pivots].tril_(before), inputs[pivots])
    return known.mT, novelty


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
