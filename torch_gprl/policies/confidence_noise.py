"""Exploration scaled by the model's confidence: the thesis' equation (.15).

    a = f(s) + σ(s) ε,   σ²(s) = clip(noise_scale · v(s, f(s)), floor², ceiling²)

with v the latent variance of the action value. Both sides are without units, v in variances of the critic's
targets and σ in halves of the actuator's range, so one scale serves every task.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false, reportIncompatibleMethodOverride=false

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import IndependentNormal

from torch_gprl.critics import GPActionValue
from torch_gprl.policies.gaussian import ActionHead, NormalPolicy, explores
from torch_gprl.policies.streams import NoiseStream

Greedy = Callable[[Tensor], Tensor]
"""Observations [*batch, ..., S] to the best known actions [*batch, ..., A], in the actuator's units."""


@dataclass(frozen=True)
class ConfidenceScale:
    """How far to explore where the critic's latent variance is v.

    Raises:
        ValueError: a scale below 0, or bounds that are not 0 < floor ≤ ceiling.
    """

    noise_scale: float = 1.0  # σ² in squared halves of the actuator's range, for v of one target variance
    floor: float = 0.05  # smallest standard deviation, in halves of the actuator's range
    ceiling: float = 1.0  # largest standard deviation, in halves of the actuator's range

    def __post_init__(self) -> None:
        """Refuse what is no scale."""
        if not self.noise_scale >= 0:
            raise ValueError(f"noise_scale must be at least 0, got {self.noise_scale}")
        if not 0 < self.floor <= self.ceiling:
            raise ValueError(
                f"floor and ceiling must be 0 < floor ≤ ceiling, got {self.floor}, {self.ceiling}"
            )

    def std(self, critic: GPActionValue, observation: Tensor, action: Tensor) -> Float[Tensor, "*batch A"]:
        """σ(s) [*batch, A], in the actuator's units, at observations [*batch, S] and actions [*batch, A]."""
        low, high = action_box(critic)
        variance = critic.gp.posterior(critic.inputs(observation, action)).variance
        share = self.share(variance).reshape(observation.shape[:-1]).unsqueeze(-1)
        return (share * (high - low) / 2).to(action.dtype)

    def share(self, variance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """σ in halves of the actuator's range, where the variance has no units either."""
        return (self.noise_scale * variance).clamp(self.floor**2, self.ceiling**2).sqrt()


def action_box(critic: GPActionValue) -> tuple[Float[Tensor, " A"], Float[Tensor, " A"]]:
    """Lower and upper bounds of the actions that a critic sees.

    Raises:
        ValueError: the critic has none.
    """
    if critic.action_low is None or critic.action_high is None:
        raise ValueError("exploration needs bounded actions: give the critic action_low and action_high")
    return critic.action_low, critic.action_high


class ConfidenceHead(ActionHead):
    """Writes `loc` = f(s), and `scale` = `action_std` = σ(s).

    Args:
        greedy: f, in the actuator's units; a module's parameters are trained with the policy.
        critic: the action value with the actuator's bounds; neither trained nor saved with the policy.
        scale: from variance to σ.
        exact: whether σ passes a gradient on to f.
    """

    critic: GPActionValue

    def __init__(self, greedy: Greedy, critic: GPActionValue, scale: ConfidenceScale, exact: bool) -> None:
        super().__init__(str(critic.in_keys[0]))
        action_box(critic)
        self.out_keys = ["loc", "scale", "action_std"]
        self.greedy, self.scale, self.exact = greedy, scale, exact
        object.__setattr__(self, "critic", critic)

    def mean_at(self, observation: Tensor) -> Tensor:
        """f(s) [*batch, A] in the observation's dtype."""
        return self.greedy(observation).to(observation.dtype)

    def parameters_at(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """f(s) and σ(s), [*batch, A] each."""
        loc = self.mean_at(observation)
        if self.exact:
            return loc, self.scale.std(self.critic, observation, loc)
        with torch.no_grad():
            return loc, self.scale.std(self.critic, observation, loc)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `loc`, `scale` and `action_std`."""
        super().forward(tensordict)
        return tensordict.set("action_std", tensordict.get("scale"))


class ConfidenceNoise(NormalPolicy):
    """Gaussian noise round a greedy map, wide where the critic is unsure.

    Writes `loc`, `scale`, `action`, `action_log_prob` and `action_std`, the σ that was used. The critic moves
    on, so log-probabilities of stored actions take the stored σ and hold it constant, unless `exact`.

    Args:
        greedy: f, observations to actions in the actuator's units: a `ScaledController`, or the maximiser of
            the critic.
        critic: the action value; knows the actuator's bounds.
        scale: from variance to σ.
        noise: a stream per learner; TorchRL's global generator if None.
        exact: differentiate log-probabilities through σ(s), under the critic as it stands.

    Raises:
        ValueError: the critic does not know the actuator's bounds.
    """

    def __init__(
        self,
        greedy: Greedy,
        critic: GPActionValue,
        scale: ConfidenceScale | None = None,
        noise: NoiseStream | None = None,
        exact: bool = False,
    ) -> None:
        head = ConfidenceHead(greedy, critic, scale or ConfidenceScale(), exact)
        super().__init__(head, noise, str(critic.in_keys[1]))

    @property
    def head(self) -> ConfidenceHead:
        """The module of f(s) and σ(s)."""
        head = self.module[0]
        assert isinstance(head, ConfidenceHead)
        return head

    def forward(self, tensordict: TensorDictBase, *args: object, **kwargs: object) -> TensorDictBase:
        """Write the distribution's parameters, an action and its log-probability; f(s) alone to exploit."""
        if not explores():
            return tensordict.set(self.action_key, self.head.mean_at(tensordict.get(self.head.in_keys[0])))
        written = super().forward(tensordict, *args, **kwargs)
        return written.set("action_std", written.get("scale"))

    def get_dist(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None, **kwargs: object
    ) -> IndependentNormal:
        """N(f(s), σ²) at the data's observations, with the data's own `action_std` if there is one."""
        observation, used = tensordict.get(self.head.in_keys[0]), tensordict.get("action_std", None)
        if used is None or self.head.exact:
            return IndependentNormal(*self.head.parameters_at(observation))
        return IndependentNormal(self.head.mean_at(observation), used)
