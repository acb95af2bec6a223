"""Actions of a Gaussian policy as the actuator sees them: their mean and variance after clipping.

E_a Q(s, a) has a closed form for a Gaussian action. The actuator clips what the policy asks for, and the
clipped Gaussian is replaced by the Gaussian of the same two moments: exact where Q is quadratic in the action
within the bounds, and flat in the policy's mean where that lies far outside, as the true average is.
"""

import math

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor


def action_moments(
    policy: ProbabilisticTensorDictSequential, tensordict: TensorDictBase
) -> tuple[Float[Tensor, "*batch A"], Float[Tensor, "*batch A"]]:
    """Mean and standard deviation [*batch, A] of a Gaussian policy's action; differentiable in the policy.

    Args:
        policy: writes `loc` and `scale` of a normal distribution before it samples, such as `GaussianPolicy`
            or TorchRL's `ProbabilisticActor` with a `Normal` or `IndependentNormal` (not a `TanhNormal`).
        tensordict: has the policy's in_keys; is left as it is.

    Raises:
        ValueError: the policy writes no `loc` or no `scale`.
    """
    parameters = policy.get_dist_params(tensordict.select(*policy.in_keys))
    assert isinstance(parameters, TensorDictBase)
    if "loc" not in parameters.keys() or "scale" not in parameters.keys():  # noqa: SIM118  (a tensordict)
        raise ValueError(
            "averages over the policy need a Gaussian policy that writes loc and scale, got keys "
            f"{sorted(map(str, parameters.keys()))}"
        )
    return parameters.get("loc"), parameters.get("scale")


def clipped_moments(
    mean: Float[Tensor, "*batch A"],
    std: Float[Tensor, "*batch A"],
    low: Float[Tensor, "*#batch A"],
    high: Float[Tensor, "*#batch A"],
) -> tuple[Float[Tensor, "*batch A"], Float[Tensor, "*batch A"]]:
    """Mean and variance of clip(a, low, high) for a ~ N(mean, std²), elementwise, in closed form.

    Differentiable in mean and std. With α = (low − mean)/std and β = (high − mean)/std,

        E[u] = α Φ(α) + β (1 − Φ(β)) + φ(α) − φ(β)   for u = (clip(a) − mean)/std.
    """
    # moments round the clipped mean keep their digits where nearly all actions are clipped
    centre = torch.clamp(mean, low, high)
    below, above, shift = (low - centre) / std, (high - centre) / std, (mean - centre) / std
    α, β = (low - mean) / std, (high - mean) / std
    mass_below, mass_above = _cdf(α), _cdf(-β)
    inside = 1 - mass_below - mass_above
    edge_low, edge_high = _density(α), _density(β)
    first = below * mass_below + above * mass_above + shift * inside + edge_low - edge_high
    second = (
        below.square() * mass_below
        + above.square() * mass_above
        + (shift.square() + 1) * inside
        + 2 * shift * (edge_low - edge_high)
        + α * edge_low
        - β * edge_high
    )
    # where everything is clipped nothing but roundoff is left of the variance, of either sign
    variance = (second - first.square()).clamp_min(0)
    return centre + std * first, std.square() * variance


def _cdf(x: Tensor) -> Tensor:
    return 0.5 * torch.erfc(-x / math.sqrt(2))


def _density(x: Tensor) -> Tensor:
    return torch.exp(-0.5 * x.square()) / math.sqrt(2 * math.pi)
