"""A prior of values from experience, with an ordinary one for what experience cannot tell.

The length scales of both come from an ordinary kernel fitted to values, a matter of milliseconds; amplitudes
are left to the marginal likelihood. Length scales of the graph itself would need the graph anew at every step
of a fit, and a graph of half the data, as a fair fit needs it, prefers units that suit no whole one.
"""

import math

from jaxtyping import Float
from torch import Tensor
from torch.distributions import LogNormal

from torch_gprl.graphs.experience import Experience
from torch_gprl.kernels.base import Sum
from torch_gprl.kernels.graph_successor import FIRST_DOUBT, SuccessorKernel
from torch_gprl.kernels.parameters import PositiveValue
from torch_gprl.kernels.stationary import Matern

REWARDS = 2.0  # length scales of rewards, in those of values, which are rougher
REST = 0.2  # prior variance of what the successor kernel cannot tell
WIDE, NARROW = 1.0, 0.3  # standard deviations of logarithms


class SuccessorWithRest(Sum):
    """`SuccessorKernel` + Matérn 1/2, with length scales by `suit` and priors that keep both alive.

    Without priors the marginal likelihood of a few hundred returns, most of them told exactly by the graph,
    leaves no variance for the few that are not.

    Args:
        experience: visited states and transitions; may grow at any time.
        discount: γ of the values that are learned, between 0 and 1.
        lengthscale: of rewards and of the rest until `suit`, in units of the inputs; broadcasts to
            [*batch, D].
        lookahead: as `SuccessorKernel`.

    Raises:
        ValueError: as `SuccessorKernel`.
    """

    def __init__(
        self, experience: Experience, discount: float, lengthscale: PositiveValue = 1.0, lookahead: int = 20
    ) -> None:
        dims, batch = experience.states.shape[-1], experience.states.shape[:-2]
        told = SuccessorKernel(experience, discount, lengthscale, lookahead=lookahead)
        rest = Matern(dims, lengthscale, REST, batch, smoothness=0.5)
        for kernel in (told, rest):
            kernel.log_lengthscale.requires_grad_(False)
        told.set_prior("outputscale", LogNormal(0.0, WIDE))
        told.set_prior("doubt", LogNormal(math.log(FIRST_DOUBT), NARROW))
        rest.set_prior("outputscale", LogNormal(math.log(REST), NARROW))
        super().__init__(told, rest)

    @property
    def told(self) -> SuccessorKernel:
        """What experience tells."""
        told = self.kernels[0]
        assert isinstance(told, SuccessorKernel)
        return told

    @property
    def rest(self) -> Matern:
        """What it cannot tell."""
        rest = self.kernels[1]
        assert isinstance(rest, Matern)
        return rest

    def suit(self, lengthscale: Float[Tensor, "*#batch D"]) -> None:
        """Take all length scales, and the units of the graph, from those of an ordinary kernel of values.

        See `Experience.pulled_back`. What a process has learned needs `rebase` afterwards.

        Args:
            lengthscale: of a Matérn 1/2 kernel fitted to values [*batch, D], in units of the inputs.
        """
        experience = self.told.experience
        experience.measure(experience.pulled_back(lengthscale.detach(), self.told.discount))
        self.told.lengthscale = REWARDS * experience.lengthscale
        self.rest.lengthscale = lengthscale.detach().expand(experience.lengthscale.shape)
