r"""Weights of the scores in a policy gradient: every way to say how good an action was, behind one name.

The gradient is E[Σ_t ∇ log π(a_t|s_t) w_t]. What w_t may be, with m = min(horizon, steps to the end), the
return to go G_t, the critic's Q, and V(s) = E_a Q(s, a):

| name | w_t | source |
|---|---|---|
| `return` | G_0 of the episode | Williams (1992); the thesis' (.4) |
| `reward-to-go` | G_t | Sutton, McAllester, Singh and Mansour (1999) |
| `mean-baseline` | G_t less its mean over the other environments | leave-one-out: unbiased |
| `optimal-baseline` | the same, weighed by squared scores | Weaver and Tao (2001), Greensmith et al. (2004) |
| `value-baseline` | G_t − V(s_t) | |
| `k-step` | Σ_{i<m} γ^i r_{t+i} + γ^m Q(s_{t+m}, a_{t+m}) | the thesis' (.7), as printed |
| `k-step-baseline` | Σ_{i<m} γ^i r_{t+i} + γ^m V(s_{t+m}) − V(s_t) | |
| `generalised` | Σ_i (γλ)^i (r_{t+i} + γ V(s_{t+i+1}) − V(s_{t+i})) | Schulman et al. (2016) |
| `advantage` | Q(s_t, a_t) − V(s_t) | |
| `all-action` | none: E_a ∇ log π(a\|s_t) Q(s_t, a) in closed form | Ciosek and Whiteson (2018) |
| `control-variate` | G_t − Q(s_t, a_t), beside the all-action term | Gu et al. (2017): unbiased |

G_t counts real rewards up to the end of the episode, and past a time limit, or where the rollout is cut, the
critic's V of the state reached; an empty critic has V = 0. Names that the critic takes part in otherwise than
by that V are biased as far as the critic is wrong; `value-baseline` and `control-variate` are not.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torch_gprl.critics.returns import k_step_returns

EstimatorName = Literal[
    "return",
    "reward-to-go",
    "mean-baseline",
    "optimal-baseline",
    "value-baseline",
    "k-step",
    "k-step-baseline",
    "generalised",
    "advantage",
    "all-action",
    "control-variate",
]


@dataclass(frozen=True)
class Evaluation:
    """A rollout in numbers: what happened, and what the critic says of it. All [*batch, T].

    Args:
        reward: r_t.
        done, terminated: whether step t ends its episode, and whether for good.
        taken: Q(s_t, a_t).
        value: V(s_t).
        next_value: V of the state that step t reaches, whether or not the episode ends there.
        square_score: |∂ log π(a_t|s_t) / ∂(mean, log std)|², the squared score as far as the policy's
            distribution goes.
        discount: γ.
        horizon: real rewards of the k-step names.
        trace: λ of `generalised`.
    """

    reward: Float[Tensor, "*batch T"]
    done: Bool[Tensor, "*batch T"]
    terminated: Bool[Tensor, "*batch T"]
    taken: Float[Tensor, "*batch T"]
    value: Float[Tensor, "*batch T"]
    next_value: Float[Tensor, "*batch T"]
    square_score: Float[Tensor, "*batch T"]
    discount: float
    horizon: int
    trace: float

    @cached_property
    def last(self) -> Bool[Tensor, "*batch T"]:
        """Whether step t is the last of its episode or of the rollout."""
        last = self.done.clone()
        last[..., -1] = True
        return last

    @cached_property
    def beyond(self) -> Float[Tensor, "*batch T"]:
        """V of the state that step t reaches: 0 where it is terminal, since nothing follows."""
        return torch.where(self.terminated, 0.0, self.next_value)

    @cached_property
    def to_go(self) -> Float[Tensor, "*batch T"]:
        """G_t."""
        return k_step_returns(
            self.reward, self.beyond, self.done, self.discount, max(1, self.reward.shape[-1])
        )

    @cached_property
    def first_return(self) -> Float[Tensor, "*batch T"]:
        """G at the first step of the episode that step t belongs to, as far as the rollout shows it."""
        first = torch.cat([torch.ones_like(self.done[..., :1]), self.done[..., :-1]], -1)
        steps = torch.arange(first.shape[-1], device=first.device).expand(first.shape)
        return self.to_go.gather(-1, (steps * first).cummax(-1).values)

    def bootstrapped(self, ahead: Float[Tensor, "*batch T"]) -> Float[Tensor, "*batch T"]:
        """Up to `horizon` rewards, at least one, then what `ahead` says of the state that step t reaches."""
        return k_step_returns(self.reward, ahead, self.done, self.discount, max(1, self.horizon))


def _k_step(seen: Evaluation) -> Tensor:
    if seen.horizon == 0:
        return seen.taken
    following = torch.cat([seen.taken[..., 1:], seen.taken[..., -1:]], -1)
    return seen.bootstrapped(torch.where(seen.last, seen.beyond, following))


def _k_step_baseline(seen: Evaluation) -> Tensor:
    return (seen.taken if seen.horizon == 0 else seen.bootstrapped(seen.beyond)) - seen.value


def _generalised(seen: Evaluation) -> Tensor:
    columns = (seen.value, seen.next_value, seen.reward, seen.last, seen.terminated)
    # not TorchRL's vectorised form, which fails for λ = 0; plain numbers would be rounded to single precision
    discount, trace = (seen.value.new_tensor(rate) for rate in (seen.discount, seen.trace))
    advantage, _ = generalized_advantage_estimate(
        discount,  # pyright: ignore[reportArgumentType]
        trace,  # pyright: ignore[reportArgumentType]
        *(column.unsqueeze(-1) for column in columns),
    )
    return advantage.squeeze(-1)


def _mean_baseline(seen: Evaluation) -> Tensor:
    return seen.to_go - _others_mean(seen.to_go, torch.ones_like(seen.to_go))


def _optimal_baseline(seen: Evaluation) -> Tensor:
    return seen.to_go - _others_mean(seen.to_go, seen.square_score)


def _others_mean(values: Tensor, weight: Tensor) -> Float[Tensor, "*batch 1"]:
    """Weighted mean over the steps of all environments [..., envs, T] but one's own: [..., envs, 1].

    Raises:
        ValueError: there is only one environment.
    """
    if values.ndim < 2 or values.shape[-2] < 2:
        raise ValueError(
            "a baseline from the other environments needs at least 2 of them, got data of shape "
            f"{tuple(values.shape)} [..., environments, time]; use 'value-baseline' with one"
        )
    total, mass = (weight * values).sum(-1, keepdim=True), weight.sum(-1, keepdim=True)
    return (total.sum(-2, keepdim=True) - total) / (mass.sum(-2, keepdim=True) - mass)


# Keep the names in step with `EstimatorName`.
ESTIMATORS: dict[str, Callable[[Evaluation], Tensor]] = {
    "return": lambda seen: seen.first_return,
    "reward-to-go": lambda seen: seen.to_go,
    "mean-baseline": _mean_baseline,
    "optimal-baseline": _optimal_baseline,
    "value-baseline": lambda seen: seen.to_go - seen.value,
    "k-step": _k_step,
    "k-step-baseline": _k_step_baseline,
    "generalised": _generalised,
    "advantage": lambda seen: seen.taken - seen.value,
    "all-action": lambda seen: torch.zeros_like(seen.reward),
    "control-variate": lambda seen: seen.to_go - seen.taken,
}
USE_ALL_ACTIONS = frozenset({"all-action", "control-variate"})  # those with the closed-form term
