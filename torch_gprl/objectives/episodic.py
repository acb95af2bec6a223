"""The episodic natural actor-critic: the natural gradient by regression of returns on compatible features.

Peters and Schaal (2008), "Natural actor-critic", table 2 (eNAC). Summed over an episode, the advantages of
its actions are what its return exceeds V(s_0) by. With the compatible advantage ∇log π(a|s)ᵀw that is

    Σ_t γ^t r_t = J + (Σ_t γ^t ∇log π(a_t|s_t))ᵀ w,

one linear equation for each episode, and its least-squares solution w is the natural gradient. With fewer
episodes than parameters it is the shortest of all solutions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import one_hot

LEAST_SPREAD = 1e-9  # of a direction among episodes, in the largest one's, for it to count


class Episodes(NamedTuple):
    """Which steps of a rollout make up each episode: weights γ^t at its own steps, 0 elsewhere."""

    weights: Float[Tensor, "K learners envs T"]
    used: Bool[Tensor, "learners K"]

    def sums(self, values: Float[Tensor, "learners envs T"]) -> Float[Tensor, "learners K"]:
        """Σ_t γ^t of a value over each episode."""
        return torch.einsum("klet,let->lk", self.weights, values.to(self.weights.dtype))


def split_episodes(done: Bool[Tensor, "learners envs T"], discount: float = 1.0) -> Episodes:
    """The episodes of a rollout; those that it cuts, at either end, count as far as it shows them."""
    starts = torch.cat([torch.ones_like(done[..., :1]), done[..., :-1]], -1)
    number = starts.cumsum(-1) - 1
    time = torch.arange(done.shape[-1], device=done.device).expand(done.shape)
    weight = discount ** (time - (time * starts).cummax(-1).values).double()
    in_order = one_hot(number).movedim(-1, 0)  # [order, learners, envs, T]
    own = one_hot(torch.arange(done.shape[1], device=done.device))[:, None, :, None]  # [envs, 1, envs, 1]
    weights = (weight * in_order.unsqueeze(1) * own).flatten(0, 1)
    return Episodes(weights, weights.flatten(2).any(-1).mT)


def episode_scores(
    log_prob: Float[Tensor, "learners envs T"], parameters: Sequence[nn.Parameter], episodes: Episodes
) -> Float[Tensor, "learners K P"]:
    """Σ_t γ^t ∇log π(a_t|s_t) of each episode.

    Args:
        log_prob: log π(a_t|s_t), differentiable in the parameters.
        parameters: each [learners, ...]; a learner's log-probabilities depend on its own alone.
        episodes: as `split_episodes` gives them.
    """
    weights = episodes.weights.to(log_prob.dtype)
    scores = torch.autograd.grad(log_prob, parameters, weights, is_grads_batched=True)
    return torch.cat([score.flatten(2) for score in scores], -1).transpose(0, 1)


def compatible_weights(
    scores: Float[Tensor, "learners K P"],
    returns: Float[Tensor, "learners K"],
    used: Bool[Tensor, "learners K"],
) -> Float[Tensor, "learners P"]:
    """The shortest w of least squares in R = J + Ψ w over the episodes that count.

    One episode alone says nothing of w, which is zero then.
    """
    count = used.sum(1, keepdim=True).clamp_min(1)
    # J takes up the means
    returns = torch.where(used, returns - (returns * used).sum(1, keepdim=True) / count, 0.0).double()
    scores = scores.double() * used.unsqueeze(-1)
    centred = (scores - scores.sum(1, keepdim=True) / count.unsqueeze(-1)) * used.unsqueeze(-1)
    # Ψ⁺ = Ψᵀ(ΨΨᵀ)⁺: the matrix has the size of the episodes, not of the parameters
    inverse = torch.linalg.pinv(centred @ centred.mT, rtol=LEAST_SPREAD, hermitian=True)
    return (centred.mT @ (inverse @ returns.unsqueeze(-1))).squeeze(-1)
