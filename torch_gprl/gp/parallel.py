"""One sparse process from the data of several processes: pseudo-likelihoods add up, by all-reduce.

What data say of the basis values, Φ W Φᵀ, Φ W y and the constant of the evidence, is a sum over points (see
`whitened`). So each of W processes weighs its own points, one all-reduce adds the sums, and all of them hold
the posterior that one machine with all the data would have. What travels does not grow with the data: about
m²/2 + m numbers for m basis vectors, besides novel points, of which all processes choose the same ones.

The processes are those of `torch.distributed`: gloo on CPUs, NCCL on GPUs.
"""

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torch_gprl.gp.door import admit_data
from torch_gprl.gp.observed import Observed
from torch_gprl.gp.selection import select_novel
from torch_gprl.gp.sparse_online import SparseOnlineGP
from torch_gprl.gp.whitened import NOVELTY_FLOOR, squared_columns
from torch_gprl.kernels.gaussian_inputs import GaussianInputs


class ParallelSparseGP(SparseOnlineGP):
    """A sparse process with a replica in each of `torch.distributed`'s processes; see `SparseOnlineGP`.

    Made with the same arguments everywhere, after `init_process_group`; `broadcast_state` makes replicas
    equal that are not. All of them call `update` together, each with its own data: one exchange, however many
    points, which equals an update of one process by all data as a single block. Everything else is local.

    Replicas stay equal where processes compute alike: on machines of one kind.

    Raises:
        RuntimeError: there is no process group.
        ValueError: `order="arrival"`, which has no meaning for data that arrive together.
    """

    def __init__(self, *args, **options) -> None:  # noqa: ANN002, ANN003  (those of SparseOnlineGP)
        super().__init__(*args, **options)
        if not dist.is_initialized():
            raise RuntimeError(
                "a parallel process needs torch.distributed: call init_process_group first, or take "
                "SparseOnlineGP for one process"
            )
        if self.order != "novelty":
            raise ValueError("data of several processes arrive together: order must be 'novelty'")

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
        """Bayes' rule on the data of all processes; see `SparseOnlineGP.update`.

        Raises:
            ValueError: numbers of points differ between processes, or any process has data that
                `SparseOnlineGP` refuses; nothing was changed then, in any of them.
        """
        observed = self._admitted(inputs, targets, mask, next_inputs, discount)
        refused = isinstance(observed, ValueError)
        points = 0 if refused else observed.inputs.shape[-2]
        extremes = torch.tensor([points, -points, refused], device=self.size.device)
        dist.all_reduce(extremes, op=dist.ReduceOp.MAX)  # or the others would wait for this one for ever
        most, least, any_refused = extremes.tolist()
        if refused:
            raise observed
        if any_refused:
            raise ValueError("another process has data that it refuses; its error tells which")
        if most != -least:
            raise ValueError(
                f"every process must bring as many points, got {-least} to {most}; fill up the shorter ones "
                "and leave that out by mask="
            )
        if stamp is not None:
            self.clock.fill_(stamp)
        if self._kernel_versions() != self._kernel_seen:
            self.rebase()
        if most:
            self._absorb_block(observed, self.noise_variance.unsqueeze(-1))

    def _admitted(
        self,
        inputs: Tensor,
        targets: Tensor,
        mask: Tensor | None,
        next_inputs: Tensor | GaussianInputs | None,
        discount: float | Tensor,
    ) -> Observed | ValueError:
        """This process' data, or why they cannot be learned."""
        try:
            admitted = admit_data(inputs, targets, mask, self.batch_shape, self.basis)
            return self._observed(*admitted, next_inputs, discount)
        except ValueError as error:
            return error

    def _absorb_block(self, block: Observed, noise: Tensor) -> None:
        points = self._points_of_all(block)
        phi, novelty = self._grow_together(block, noise, points)
        if block.next_inputs is not None and block.discount is not None:
            phi, novelty = self._difference(phi, block.inputs, block.next_inputs, block.discount)
        variance = noise + novelty if self.projection == "moment" else noise.expand_as(novelty)
        self._accumulate(phi, variance, block.targets, block.mask)
        full = self.size > self.capacity - self._room(points)
        if bool(full.any()):
            self._prune(full)

    def _points_of_all(self, block: Observed) -> Int[Tensor, "*batch"]:
        """How many points count, over all processes."""
        if block.mask is None:
            return torch.full_like(self.size, block.targets.shape[-1] * dist.get_world_size())
        points = block.mask.sum(-1)
        dist.all_reduce(points)
        return points

    def _grow_together(
        self, block: Observed, noise: Tensor, points: Tensor
    ) -> tuple[Float[Tensor, "*batch R N"], Float[Tensor, "*batch N"]]:
        """Add the novel points of all processes to the basis; φ and novelty of this one's then."""
        phi, novelty, candidate = self._judge(block.inputs, block.mask, noise)
        most = candidate.sum(-1).max()
        dist.all_reduce(most, op=dist.ReduceOp.MAX)
        if not int(most):
            return phi, novelty
        first = novelty.where(candidate, -torch.inf).topk(int(most), -1).indices.sort(-1).values
        wide = first.unsqueeze(-1).expand(*first.shape, block.inputs.shape[-1])
        inputs = _gathered(block.inputs.gather(-2, wide), dim=-2)
        mask = _gathered(candidate.gather(-1, first), dim=-1)

        phi, novelty, _ = self._judge(inputs, mask, noise)
        residual = self.kernel(inputs, inputs) - phi.mT @ phi
        wanted = (self.budget - self.size).clamp_min(0) + self._churn(points)
        limit = torch.minimum(wanted, self.capacity - self.size)
        selection = select_novel(
            residual, novelty.where(mask, -torch.inf), self._threshold(inputs, noise), limit
        )
        self._add(selection, inputs, phi)
        return self._judge(block.inputs, block.mask, noise)[:2]

    def _judge(
        self, inputs: Tensor, mask: Tensor | None, noise: Tensor
    ) -> tuple[Float[Tensor, "*batch R N"], Float[Tensor, "*batch N"], Bool[Tensor, "*batch N"]]:
        """φ and novelty of points, and which of them are novel enough for the basis."""
        phi = self._features(inputs)
        novelty = self.kernel.diag(inputs) - squared_columns(phi)
        candidate = novelty > self._threshold(inputs, noise)
        return phi, novelty, candidate if mask is None else candidate & mask

    def _threshold(self, inputs: Tensor, noise: Tensor) -> Float[Tensor, "*batch N"]:
        prior = self.kernel.diag(inputs)
        return torch.maximum(self.novelty_threshold * noise, NOVELTY_FLOOR[prior.dtype] * prior)

    def _accumulate(self, phi: Tensor, variance: Tensor, targets: Tensor, mask: Tensor | None) -> None:
        """Add the sums over this process' points, and those of all others."""
        sums = (self.precision, self.information, self.evidence_constant, self.observations)
        before = [tensor.clone() for tensor in sums]
        for tensor in sums:
            tensor.zero_()
        super()._accumulate(phi, variance, targets, mask)
        rows = phi.shape[-2]
        row, column = torch.tril_indices(rows, rows, device=phi.device).unbind()
        lower = self.precision[..., row, column]  # the rest is its mirror image
        numbers = [lower, self.information[..., :rows], *(x.unsqueeze(-1).to(lower) for x in sums[2:])]
        message = torch.cat(numbers, -1)
        dist.all_reduce(message)
        lower, information, constant, count = message.split([len(row), rows, 1, 1], -1)
        self.precision[..., row, column] = lower
        self.precision[..., column, row] = lower
        self.information[..., :rows] = information
        self.evidence_constant.copy_(constant.squeeze(-1))
        self.observations.copy_(count.squeeze(-1))
        for tensor, old in zip(sums, before, strict=True):
            tensor.add_(old)


def broadcast_state(module: nn.Module, source: int = 0) -> None:
    """Give all processes the state that `module` has in process `source`: basis, posterior, scaling, kernel.

    Called by all processes, with modules of one shape: after a fit of hyper-parameters or of a critic's
    scaling, which only one of them has made.
    """
    state = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    for name in sorted(state):
        dist.broadcast(state[name], source)
    module.load_state_dict(state)


def _gathered(tensor: Tensor, dim: int) -> Tensor:
    """The tensors of all processes side by side along `dim`."""
    parts = [torch.empty_like(tensor) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, tensor.contiguous())
    return torch.cat(parts, dim)
