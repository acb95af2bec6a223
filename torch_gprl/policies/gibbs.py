"""Gibbs exploration, guided by the action value near the controller: the thesis' equations (.16) and (.17).

    π(a|s) ∝ exp(β Q̃(s, a) D(a)),   ∇_θ log π(a|s) = β Q̃(s, a) ∇_θ D(a) − E_π[β Q̃ ∇_θ D]

for the printed energy; `gibbs_energy` has both. One action dimension is weighed on a grid and sampled by the
exact inverse; more dimensions are weighed at candidates, and samples may be moved on by Hamiltonian Monte
Carlo. Scores come from autograd, through the same normaliser that samples.
"""

# tensordict wraps the methods of its modules in decorators that hide their signatures:
# pyright: reportIncompatibleVariableOverride=false, reportIncompatibleMethodOverride=false

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.modules import IndependentNormal

from torch_gprl.critics import GPActionValue
from torch_gprl.critics.maximise import ActionMaximiser
from torch_gprl.policies.candidate_density import CandidateDensity, Candidates, Proposal
from torch_gprl.policies.confidence_noise import ConfidenceScale, Greedy, action_box
from torch_gprl.policies.gaussian import ActionHead, explores
from torch_gprl.policies.gibbs_energy import EnergyForm, ValueRange, Window, log_density
from torch_gprl.policies.grid_density import GridDensity
from torch_gprl.policies.hamiltonian import HamiltonianConfig, HamiltonianSampler
from torch_gprl.policies.streams import NoiseStream

Sampler = Literal["candidates", "hamiltonian"]


@dataclass(frozen=True)
class GibbsConfig:
    """How the value guides.

    Raises:
        ValueError: a number out of its range.
    """

    form: EnergyForm = "robust"  # the thesis' energy, or its sibling whose guidance ends near the controller
    inverse_temperature: float = 3.0  # β at first, for values scaled by their range over the actions
    final_inverse_temperature: float = 30.0  # β at last; it grows by equal factors
    width: float = 0.5  # σ_e, reach of the guidance round the controller, in halves of the actuator's range
    points: int = 101  # actions weighed at each state, in one dimension a grid
    sampler: Sampler = "candidates"  # more than one action dimension: which draws the action
    hamiltonian: HamiltonianConfig = field(default_factory=HamiltonianConfig)

    def __post_init__(self) -> None:
        """Refuse what is no density."""
        if not (self.inverse_temperature > 0 and self.final_inverse_temperature > 0):
            raise ValueError(f"inverse temperatures must be positive, got {self}")
        if not self.width > 0:
            raise ValueError(f"width must be positive, got {self.width}")
        for name, kind in (("form", EnergyForm), ("sampler", Sampler)):
            if getattr(self, name) not in get_args(kind):
                choices = " or ".join(get_args(kind))
                raise ValueError(f"{name} must be {choices}, got {getattr(self, name)!r}")


class GibbsHead(ActionHead):
    """Weighs actions: writes `loc` and `scale`, mean and standard deviation of the density.

    What the critic says of a state is kept as a tensordict, its `opinion`: Q̃ of the actions weighed, and σ_e.
    The density of an opinion depends on the controller alone.
    """

    critic: GPActionValue
    low: Tensor
    high: Tensor
    inverse_temperature: Tensor

    def __init__(
        self, greedy: Greedy, critic: GPActionValue, config: GibbsConfig, confidence: ConfidenceScale | None
    ) -> None:
        super().__init__(str(critic.in_keys[0]))
        self.greedy, self.config, self.confidence = greedy, config, confidence
        object.__setattr__(self, "critic", critic)
        low, high = (bound.to(critic.input_loc) for bound in action_box(critic))
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("inverse_temperature", low.new_tensor(config.inverse_temperature))
        # the grid in one dimension; in more an even cover, the same for all states, that gives Q̃ its range
        self.cover = ActionMaximiser(critic, low, high, candidates=config.points)
        even = config.points + config.points % 2  # candidates come in two halves
        self.proposal = Proposal(low, high, even) if len(low) > 1 else None

    @property
    def random_numbers(self) -> int:
        """Uniform numbers that an opinion takes."""
        return 0 if self.proposal is None else len(self.low)

    def mean_at(self, observation: Tensor) -> Tensor:
        """f(s) [*batch, A] in the observation's dtype."""
        return self.greedy(observation).to(observation.dtype)

    def parameters_at(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the density, [*batch, A] each."""
        loc = self.mean_at(observation)
        # moments need no shift of the candidates: all states may share one set
        uniform = loc.new_zeros(*loc.shape[:-1], self.random_numbers)
        density = self.density(self.opinion(observation, loc, uniform), loc)
        return density.mean.to(loc.dtype), density.variance.sqrt().to(loc.dtype)

    @torch.no_grad()
    def opinion(self, observation: Tensor, loc: Tensor, uniform: Tensor) -> TensorDictBase:
        """What the critic says of states [*batch, S] with f(s) = `loc`.

        Args:
            observation: the states.
            loc: [*batch, A].
            uniform: numbers in [0, 1) that shift the candidates, [*batch, random_numbers].
        """
        if self.confidence is None:
            width = (self.config.width * (self.high - self.low) / 2).expand_as(loc).to(loc.dtype)
        else:
            width = self.confidence.std(self.critic, observation, loc)
        said = TensorDict({"width": width}, loc.shape[:-1])
        states = observation.reshape(*self.critic.gp.batch_shape, -1, observation.shape[-1])
        value = self.cover.candidate_values(states).reshape(*loc.shape[:-1], -1)
        value_range = ValueRange.of(value)
        if self.proposal is not None:
            candidates = self.proposal.draw(_window(loc, width, self.low), uniform.to(self.low))
            value = self._value(observation, candidates.action)
            said.update(Candidates(*(tensor.to(loc.dtype) for tensor in candidates))._asdict())
        said.set("preference", value_range.preference(value).to(loc.dtype))
        return said.update(value_range._asdict())

    def density(
        self, opinion: TensorDictBase, loc: Tensor, preference_at: Callable[[Tensor], Tensor] | None = None
    ) -> GridDensity | CandidateDensity:
        """π(·|s), differentiable in f(s).

        Args:
            opinion: of the states, see `opinion`.
            loc: f(s) [*batch, A].
            preference_at: Q̃ [*batch] of any action [*batch, A]; log-probabilities of more than one dimension
                ask for it.
        """
        window = _window(loc, opinion.get("width"), self.low)
        if self.proposal is None:
            grid = self.cover.candidates.expand(*loc.shape[:-1], -1, -1)
            return GridDensity(
                self._log_density(opinion.get("preference"), grid, window), self.low, self.high
            )
        candidates = Candidates(opinion.get("action"), opinion.get("log_proposal"))

        def log_density_at(action: Tensor) -> Tensor:
            assert preference_at is not None
            there = action.to(self.low).unsqueeze(-2)
            return self._log_density(preference_at(action).unsqueeze(-1), there, window).squeeze(-1)

        weighed = self._log_density(opinion.get("preference"), candidates.action, window)
        return CandidateDensity(candidates, weighed, log_density_at)

    def preference(self, observation: Tensor, opinion: TensorDictBase, action: Tensor) -> Tensor:
        """Q̃(s, a) [*batch] of one action at each state, differentiable in it."""
        value_range = ValueRange(opinion.get("least"), opinion.get("extent"))
        return value_range.preference(self._value(observation, action.unsqueeze(-2))).squeeze(-1)

    def _log_density(self, preference: Tensor, action: Tensor, window: Window) -> Tensor:
        return log_density(self.config.form, self.inverse_temperature, preference, action, window)

    def _value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q of several actions [*batch, P, A] at each state: [*batch, P]."""
        spread = observation.unsqueeze(-2).expand(*action.shape[:-1], -1)
        return self.critic.mean_value(spread, action)


def _window(loc: Tensor, width: Tensor, like: Tensor) -> Window:
    return Window(loc.to(like), width.to(like))


class GibbsPolicy(ProbabilisticTensorDictSequential):
    """Actions by their value near a greedy map.

    Writes `action`, `action_log_prob`, `loc` and `scale` (mean and standard deviation of the density),
    `action_std` (the latter again) and `gibbs`, what the critic said. It learns in between, so the
    log-probabilities of stored actions take the stored opinion and hold it constant: only the controller gets
    a gradient.

    Args:
        greedy: f, observations to actions in the actuator's units.
        critic: the action value; knows the actuator's bounds; neither trained nor saved with the policy.
        config: how the value guides.
        noise: a stream per learner; torch's global generator if None.
        confidence: takes σ_e from the critic's variance instead of `config.width`.
    """

    def __init__(
        self,
        greedy: Greedy,
        critic: GPActionValue,
        config: GibbsConfig | None = None,
        noise: NoiseStream | None = None,
        confidence: ConfidenceScale | None = None,
    ) -> None:
        head = GibbsHead(greedy, critic, config or GibbsConfig(), confidence)
        self.action_key = str(critic.in_keys[1])
        # TorchRL asks for a module that samples; `forward` and `get_dist` put the density in its place
        sampler = ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=[self.action_key],
            distribution_class=IndependentNormal,
            return_log_prob=True,
            default_interaction_type=InteractionType.RANDOM,  # pyright: ignore[reportArgumentType]
        )
        super().__init__([head, sampler])
        self.noise = noise
        self.chains: HamiltonianSampler | None = None
        if head.config.sampler == "hamiltonian" and len(head.low) > 1:
            self.chains = HamiltonianSampler(critic.gp.batch_shape.numel(), head.config.hamiltonian)

    @property
    def head(self) -> GibbsHead:
        """The module that weighs actions."""
        head = self.module[0]
        assert isinstance(head, GibbsHead)
        return head

    def anneal(self, share: float) -> None:
        """Set β for a share of the training that is over, 0 to 1."""
        first, last = self.head.config.inverse_temperature, self.head.config.final_inverse_temperature
        β = first ** (1 - share) * last**share
        self.head.inverse_temperature.fill_(β)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase, *args: object, **kwargs: object) -> TensorDictBase:
        """Write an action, its log-probability and what they came from; f(s) alone to exploit."""
        head = self.head
        observation = tensordict.get(head.in_keys[0])
        loc = head.mean_at(observation)
        if not explores():
            return tensordict.set(self.action_key, loc)
        normal = self._normal(loc)
        which, shift, normal = normal.tensor_split((1, 1 + head.random_numbers), -1)
        opinion = head.opinion(observation, loc, torch.special.ndtr(shift))
        density = head.density(opinion, loc, partial(head.preference, observation, opinion))
        if isinstance(density, GridDensity):
            action = density.icdf(torch.special.ndtr(which))
        else:
            action = self._move(density, density.pick(torch.special.ndtr(which)), normal)
            opinion.set("taken", head.preference(observation, opinion, action))
        written = {
            self.action_key: action,
            f"{self.action_key}_log_prob": density.log_prob(action),
            "loc": density.mean,
            "scale": density.stddev,
            "action_std": density.stddev,
        }
        return tensordict.update({key: tensor.to(loc.dtype) for key, tensor in written.items()}).set(
            "gibbs", opinion
        )

    def get_dist(
        self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None, **kwargs: object
    ) -> GridDensity | CandidateDensity:
        """The density at the data's observations, by the data's own `gibbs` opinion if there is one.

        With more than one action dimension an opinion knows the value of the action that was taken alone: ask
        for the log-probability of no other.
        """
        head, opinion = self.head, tensordict.get("gibbs", None)
        observation = tensordict.get(head.in_keys[0])
        loc = head.mean_at(observation)
        if opinion is not None:
            return head.density(opinion, loc, lambda action: opinion.get("taken"))
        uniform = loc.new_zeros(*loc.shape[:-1], head.random_numbers)
        opinion = head.opinion(observation, loc.detach(), uniform)
        return head.density(opinion, loc, partial(head.preference, observation, opinion))

    def _normal(self, loc: Tensor) -> Tensor:
        """The random numbers of a step [*batch, R]: one to choose, some to shift candidates, some to move."""
        dims = loc.shape[-1]
        count = 1 + self.head.random_numbers
        count += 0 if self.chains is None else self.chains.random_numbers(dims)
        like = self.head.low.new_empty(*loc.shape[:-1], count)
        if self.noise is None:
            return torch.randn_like(like)
        return self.noise.draw(like.reshape(len(self.noise), -1, count)).reshape(like.shape)

    def _move(self, density: CandidateDensity, action: Tensor, normal: Tensor) -> Tensor:
        """Actions after some trajectories of Hamiltonian Monte Carlo, where that is asked for."""
        if self.chains is None:
            return action
        low, high = self.head.low, self.head.high
        middle, half = (high + low) / 2, (high - low) / 2
        chains = len(self.chains.log_step)

        def log_density(position: Tensor) -> Tensor:
            at = middle + half * position
            return density.log_density_at(at.reshape(action.shape)).reshape(chains, -1)

        start = ((action - middle) / half).reshape(chains, -1, action.shape[-1])
        moved = self.chains.move(log_density, start, normal.reshape(*start.shape[:-1], -1))
        return (middle + half * moved).reshape(action.shape)
