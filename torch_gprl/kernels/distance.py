"""Squared Euclidean distances between two sets of points, fast and with all their derivatives.

|x − z|² = |x|² + |z|² − 2 xᵀz by one matrix product: `torch.cdist` has no second derivative. Points are first
moved near the origin, since the three terms cancel where points lie close together but far from zero: the
error is a few machine epsilons of the squared distance to the centre, not of the squared inputs.
"""

import torch
from torch import Tensor

# Multiplications up to which differences written out beat a matrix product with its preparation: measured at
# 20 to 40 thousand on one CPU core.
DIRECT_SIZE = 16_384


def scaled_square_distance(x: Tensor, z: Tensor, scale: float = 1.0, offset: Tensor | None = None) -> Tensor:
    """Compute offset + scale · |x − z|² for every pair of rows of x [*b, N, D] and z [*b, M, D]: [*b, N, M].

    One product of [scale (−2x, |x|²), 1] with [z, 1, scale |z|² + offset] gives scale and offset for free.
    The same tensor given twice has exactly `offset` on its diagonal. Elsewhere rounding may leave a distance
    a few machine epsilons below zero. Clamping is left to callers whose next step needs it: it would cut the
    second derivative at coincident points, where the squared exponential has a large one.

    Args:
        x: points, already divided by length scales.
        z: points.
        scale: multiplies the squared distance.
        offset: added to every entry, [*b]; at most the batch dimensions of z.
    """
    needs_grad = torch.is_grad_enabled() and (
        x.requires_grad or z.requires_grad or (offset is not None and offset.requires_grad)
    )
    if not needs_grad and x.shape[-2] * z.shape[-2] * x.shape[-1] <= DIRECT_SIZE:
        square = torch.cdist(x, z, compute_mode="donot_use_mm_for_euclid_dist").square_().mul_(scale)
        return square if offset is None else square.add_(offset[..., None, None])
    return _by_matrix_product(x, z, scale, offset)


def _by_matrix_product(x: Tensor, z: Tensor, scale: float, offset: Tensor | None) -> Tensor:
    same = x is z
    if x.shape[-2] and z.shape[-2]:
        centre = z[..., :1, :].detach()
        x, z = x - centre, z - centre
    x_norm = scale * torch.linalg.vecdot(x, x).unsqueeze(-1)
    z_norm = scale * torch.linalg.vecdot(z, z).unsqueeze(-1)
    if offset is not None:
        z_norm = z_norm + offset[..., None, None]
    left = torch.cat((-2.0 * scale * x, x_norm, torch.ones_like(x_norm)), -1)
    right = torch.cat((z, torch.ones_like(z_norm), z_norm), -1)
    square = left @ right.mT
    if same:
        diagonal = square.diagonal(dim1=-2, dim2=-1)
        diagonal.copy_(torch.zeros_like(diagonal) if offset is None else offset.unsqueeze(-1))
    return square
