"""Returns of a rollout: k real rewards, then a bootstrap (the thesis' equation (.7), its sum over i < k)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def k_step_returns(
    reward: Float[Tensor, "*batch T"],
    next_value: Float[Tensor, "*batch T"],
    done: Bool[Tensor, "*batch T"],
    discount: float,
    horizon: int,
) -> Float[Tensor, "*batch T"]:
    """Sums of up to `horizon` discounted rewards and the discounted value of the state reached.

    With m = min(horizon, steps to the end of the episode or of the rollout),

        G_t = Σ_{i<m} γ^i r_{t+i} + γ^m V_{t+m},   V_{t+m} = next_value[t+m-1].

    Time is the last dimension. A horizon past the end of every episode gives the Monte-Carlo return.

    Args:
        reward: r_t [*batch, T].
        next_value: value of the state reached by step t, 0 where that state is terminal, [*batch, T].
        done: step t ends its episode, by termination or by truncation, [*batch, T].
        discount: γ in [0, 1].
        horizon: number of real rewards, at least 1.

    Raises:
        ValueError: a horizon below 1.
    """
    if horizon < 1:
        raise ValueError(
            f"horizon must be at least 1 step, got {horizon}; horizon 0 is the critic's value itself"
        )
    # G¹_t = r_t + γ V_{t+1};  Gᵏ_t = r_t + γ (V_{t+1} if step t is the last, else Gᵏ⁻¹_{t+1})
    last = done.clone()
    last[..., -1] = True
    returns = reward + discount * next_value
    for _ in range(min(horizon, reward.shape[-1]) - 1):
        following = torch.cat([returns[..., 1:], returns[..., -1:]], -1)
        returns = reward + discount * torch.where(last, next_value, following)
    return returns
