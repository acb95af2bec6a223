"""A prior of values from experience, with an ordinary one for what experience cannot tell.

All parameters come from an ordinary kernel fitted to values, a matter of milliseconds: its length scales for
the graph and for the rest, and its variance, whole for the graph and a quarter for the rest; inputs far from
all experience get the other three. The marginal likelihood of the sum itself misleads. Points of one
trajectory tell each other nearly all through the graph, so that hardly any variance is left for the rest, and
states that no trajectory passed are then predicted with far too much confidence.
"""

from jaxtyping import Float
from torch import Tensor

from torch_gprl.graphs.experience import Experience
from torch_gprl.kernels.base import Sum
from torch_gprl.kernels.gaussian_inputs import GaussianInputs
from torch_gprl.kernels.graph_successor import SuccessorKernel
from torch_gprl.kernels.parameters import PositiveValue
from torch_gprl.kernels.stationary import Matern, Stationary

REWARDS = 2.0  # length scales of rewards, in those of values, which are rougher
REST = 0.25  # of the variance of values


class SuccessorWithRest(Sum):
    """`SuccessorKernel` + an ordinary kernel, with length scales and variances by `suit`.

    Over Gaussian columns the rest is averaged in closed form, and what experience tells is taken at the mean:
    averages over several points carry the noise of more neighbours, and rank actions less well.

    Args:
        experience: visited states and transitions; may grow at any time.
        discount: γ of the values that are learned, between 0 and 1.
        lengthscale: of rewards, and of a Matérn 1/2 rest, until `suit`, in units of the inputs; broadcasts
            to [*batch, D].
        lookahead: as `SuccessorKernel`.
        rest: another ordinary kernel of the same batch.

    Raises:
        ValueError: as `SuccessorKernel`.
    """

    def __init__(
        self,
        experience: Experience,
        discount: float,
        lengthscale: PositiveValue = 1.0,
        lookahead: int = 20,
        rest: Stationary | None = None,
    ) -> None:
        dims, batch = experience.states.shape[-1], experience.states.shape[:-2]
        told = SuccessorKernel(experience, discount, lengthscale, lookahead=lookahead)
        if rest is None:
            rest = Matern(dims, lengthscale, batch_shape=batch, smoothness=0.5)
        for kernel in (told, rest):
            kernel.log_lengthscale.requires_grad_(False)  # a fit would need the graph anew at every step
        super().__init__(told, rest)

    @property
    def told(self) -> SuccessorKernel:
        """What experience tells."""
        told = self.kernels[0]
        assert isinstance(told, SuccessorKernel)
        return told

    @property
    def rest(self) -> Stationary:
        """What it cannot tell."""
        rest = self.kernels[1]
        assert isinstance(rest, Stationary)
        return rest

    def suit(
        self, lengthscale: Float[Tensor, "*#batch D"], outputscale: float | Float[Tensor, "*#batch"] = 1.0
    ) -> None:
        """Take length scales, the units of the graph and both variances from an ordinary kernel of values.

        See `Experience.pulled_back`. What a process has learned needs `rebase` afterwards.

        Args:
            lengthscale: of a kernel like the rest, fitted to values [*batch, D], in units of the inputs.
            outputscale: its prior variance [*batch], given to what experience tells, and a quarter of it to
                the rest; inputs far from all experience get the other three.
        """
        experience = self.told.experience
        experience.measure(experience.pulled_back(lengthscale.detach(), self.told.discount))
        self.told.lengthscale = REWARDS * experience.lengthscale
        self.rest.lengthscale = lengthscale.detach().expand(experience.lengthscale.shape)
        self.told.outputscale = outputscale
        self.rest.outputscale = REST * outputscale
        self.told.unseen.fill_(1 - REST)

    def _expected(self, x: GaussianInputs, z: GaussianInputs) -> Tensor:
        return self.told(x.mean, z.mean) + self.rest.expected(x, z)
