"""Where a task ends and what an end pays, learned from the steps that ended it.

A prize is paid in one step of hundreds, and jumps: among all rewards it would be an outlier, smeared over the
way to it. So what ends pay beyond the reward expected on the way is learned apart, with where they are:

    end(s), prize(s) = k(s, S) (K + σ² I)⁻¹ [y, y · surplus],   y = 1 for an end, 0 for other visited states S
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torch_gprl.graphs import farthest_points
from torch_gprl.kernels import Kernel
from torch_gprl.linalg import cholesky

LABEL_NOISE = 1e-3  # of the regression, under a kernel of variance 1
MOST_ENDS = 50  # remembered, of each learner
NOWHERE = 1e6  # scaled coordinate of the places that a learner with fewer ends leaves empty


class Ends:
    """The ends that learners have met, and other states to tell them from.

    Args:
        kernel: of scaled states.
        others: [L, R, S] scaled states that the task went on from.
        following: [L, N, S] scaled states after steps.
        terminated: [L, N] 1 where the step ended the task, else 0.
        surplus: [L, N] what the step paid beyond what is expected on the way.

    Attributes:
        scaled: [L, E, S] ends that cover those met, and places that are nowhere.
        labels: [L, E] 1 for an end, 0 for such a place.
    """

    def __init__(
        self, kernel: Kernel, others: Tensor, following: Tensor, terminated: Tensor, surplus: Tensor
    ) -> None:
        ended = terminated > 0.5
        self.any = bool(ended.any())
        places = torch.where(ended.unsqueeze(-1), following, NOWHERE)
        chosen = farthest_points(places, min(int(ended.sum(1).max()) + 1, MOST_ENDS)).chosen
        self.scaled = places.take_along_dim(chosen.unsqueeze(-1), 1)
        self.labels = ended.gather(1, chosen).to(surplus)
        prizes = self.labels * surplus.gather(1, chosen)
        targets = torch.stack([self.labels, prizes], -1)
        targets = torch.cat([torch.zeros_like(others[..., :1]).expand(-1, -1, 2), targets], 1)
        self._kernel, self._points = kernel, torch.cat([others, self.scaled], 1)
        eye = torch.eye(targets.shape[1], dtype=targets.dtype, device=targets.device)
        factor = cholesky(kernel(self._points, self._points) + LABEL_NOISE * eye)
        self._weights = torch.cholesky_solve(targets, factor)
        self._least, self._most = (bound(targets, 1, keepdim=True) for bound in (torch.amin, torch.amax))

    def judge(self, scaled: Float[Tensor, "L N S"]) -> tuple[Float[Tensor, "L N"], Float[Tensor, "L N"]]:
        """How far states look like ends, 0 to 1, and what is paid there for that."""
        if not self.any:
            return torch.zeros_like(scaled[..., 0]), torch.zeros_like(scaled[..., 0])
        found = self._kernel(scaled, self._points) @ self._weights
        end, prize = torch.clamp(found, self._least, self._most).unbind(-1)
        return end, prize
