"""State values by dynamic programming on a learned model of the steps.

Gaussian-process dynamic programming (Deisenroth, Rasmussen and Peters, 2009): the value is a Gaussian process
on support states, and each sweep sets it there to

    V(s) = max_a r̂(s, a) + γ (1 − end(ŝ')) V(ŝ'),   ŝ' the model's prediction

Actions are held for a few steps, in sweeps and when actions are compared: what follows from them then differs
by more than the error of the values between support states, and a step errs less often on its way to the
reward. An agent still chooses anew at every step.

The process has a Matérn 1/2 kernel. Its predictions are nearly convex combinations of the values at the
support, so sweeps nearly contract; a smoother kernel overshoots and the maximum then feeds on it. Values also
keep to the attainable range. Support states are visited ones, states a few imagined steps away, and the ends
that were met, whose value is zero: what an end pays belongs to the step that leads there.

The maximum is taken over averages of nearby actions, as if the hand trembled. Where many actions serve
equally well, up to an edge beyond which none does, this keeps away from the edge.

What is performed when nothing is explored: see `performance`; who has not settled looks ahead (`look_ahead`).

A second value, for exploration, takes what the model does not know for better than all that was seen
(optimism in the face of uncertainty): a share of each backup, as large as the doubt, is the highest hope.
"""

import math
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_gprl.critics.ends import Ends
from torch_gprl.critics.look_ahead import LookAhead, variations
from torch_gprl.critics.maximise import candidate_actions
from torch_gprl.critics.performance import Imagination, Performance, prepare
from torch_gprl.critics.plan import Course, Planning, Support, attainable, trembling_weights
from torch_gprl.critics.rehearsal import SmoothPolicy, Walks, spread
from torch_gprl.critics.transition_model import MARGIN, Prediction, TransitionModel, Transitions
from torch_gprl.gp import Posterior
from torch_gprl.graphs import farthest_points
from torch_gprl.kernels import Kernel, Matern, SquaredExponential
from torch_gprl.linalg import cholesky

EXPLOIT, EXPLORE = 0, 1  # columns of the values
VALUE_NOISE, NOVELTY_NOISE = 1e-3, 1e-2  # of regressions under kernels of variance 1
IMAGINED_STEPS = 2  # from a known state to an imagined one
FIRST_SWEEPS = 3  # times as many as later: those begin from the last value
FAR = 1.0  # ranges of what was seen by which walks may leave it: its edge is no wall to lean on
CHUNK = 2**22  # numbers of the largest temporary: bounds the memory


class PlannedValue:
    """Values and action values of learners, planned on their models.

    Args:
        model: predicts steps.
        low: lower bounds of the actions, [A], in the actuator's units.
        high: upper bounds.
        planning: the numbers.
        acting_actions: actions compared when acting.

    Attributes:
        acting_actions: those actions [J, A], in halves of the actuator's range.
    """

    def __init__(
        self, model: TransitionModel, low: Tensor, high: Tensor, planning: Planning, acting_actions: int
    ) -> None:
        self.model, self.planning = model, planning
        self._centre, self._half = (low + high) / 2, (high - low) / 2
        self._backup_actions = self._candidates(low, high, planning.backup_actions)
        self.acting_actions = self._candidates(low, high, acting_actions)
        self._support: Support | None = None  # of the plan
        self._performance: Performance | None = None

    def _candidates(self, low: Tensor, high: Tensor, count: int) -> Tensor:
        return (candidate_actions(low, high, count) - self._centre) / self._half

    @property
    def planned(self) -> bool:
        """Whether there is a plan."""
        return self._support is not None

    @property
    def settled(self) -> Bool[Tensor, "L 1 1"] | None:
        """Whether learners have nothing left to explore for; None if nobody has settled."""
        performance = self._performance
        return performance.settled if performance is not None and performance.any_settled else None

    # ---------------------------------------------------------------- planning

    @torch.no_grad()
    def plan(self, data: Transitions, uniform: Float[Tensor, "L I U"], fresh: bool = True) -> None:
        """Plan anew on the model's present beliefs, from the last plan's values.

        Args:
            data: the experience that the model has learned.
            uniform: numbers in [0, 1) that choose imagined states: which known state each begins from, and
                the actions that lead there: U = 1 + 2 A columns.
            fresh: whether the model was fitted afresh: then all rehearse, else those who gained by it.
        """
        before = self._support
        kernels = self._kernels(data.observation)
        self._judge(data, kernels)
        observation = self._choose(data, uniform)
        scaled = torch.cat([self._scaled(observation), self._ends.scaled], 1)
        self._low, self._high, self._hope = attainable(data, self.planning)
        average = (self._low + self._high) / 2
        values = average.unsqueeze(-1).expand(*observation.shape[:2], 2)
        if before is not None:
            values = self._values_of(before, observation)
            average = values[..., EXPLOIT].mean(1, keepdim=True)
        prior = torch.stack([average, self._hope], -1)
        none = torch.zeros_like(prior.expand(-1, scaled.shape[1], -1))
        loc, scale = self.model.loc, self.model.scale
        self._support = Support(observation, scaled, self._ends.labels, loc, scale, prior, none)
        self._iterate(values, self.planning.sweeps * (1 if before is not None else FIRST_SWEEPS))
        last = self._performance
        if self.planning.rehearsal and (last is None or fresh or last.any_smooth):
            prepared = self._rehearsed(data)
            self._performance = prepared if last is None or fresh else prepared.where(last.smooth, last)

    def _rehearsed(self, data: Transitions) -> Performance:
        """Improve a smooth policy by the model, and choose what is performed."""
        support, planning = self._support, self.planning
        assert support is not None
        pool = torch.cat([support.observation, spread(data.observation, planning.support)], 1)
        chosen = farthest_points(self._scaled(pool), planning.support).chosen
        policy = SmoothPolicy(pool.take_along_dim(chosen.unsqueeze(-1), 1), support.loc, support.scale)
        imagination = Imagination(
            self._walks,
            lambda states: self._best_of(self.acting_actions, states, explore=False),
            lambda states: self._best_of(self._backup_actions, states, explore=False),
            lambda states: self.candidate_values(states, explore=True).amax(-1),
            data,
            self._low.squeeze(-1),
            self._high.squeeze(-1),
            planning.discount,
        )
        return prepare(imagination, policy, self._performance, planning.rehearsal, planning.ascents)

    def _walks(self, start: Float[Tensor, "L N S"], steps: int) -> Walks:
        """Imagined walks by the model, with the plan's value of where they get to."""
        support = self._support
        assert support is not None

        def step(states: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            step, end = self._step(states, actions, doubt=False, margin=FAR)
            return step.observation, step.reward, end

        def value(states: Tensor) -> Tensor:
            return self._values_of(support, states)[..., EXPLOIT]

        return Walks(step, value, start, steps, self.planning.discount)

    def _kernels(self, like: Tensor) -> tuple[Kernel, Kernel]:
        """Of values and of novelty, in scaled coordinates, where the length scale of values is 1."""
        columns = like.shape[-1]
        narrow = self.planning.novelty_lengthscale / self.planning.lengthscale
        self._kernel = Matern(columns, smoothness=self.planning.smoothness).to(like).requires_grad_(False)
        self._novelty_kernel = SquaredExponential(columns, narrow).to(like).requires_grad_(False)
        return self._kernel, self._novelty_kernel

    def _scaled(self, observation: Tensor) -> Tensor:
        unit = self.planning.lengthscale * math.sqrt(observation.shape[-1])
        return (observation - self.model.loc) / (self.model.scale * unit)

    def _judge(self, data: Transitions, kernels: tuple[Kernel, Kernel]) -> None:
        """Learn from all visited states where the task ends, what that pays, and what is new."""
        visited = self._scaled(data.observation)
        chosen = farthest_points(visited, self.planning.support).chosen
        others = visited.take_along_dim(chosen.unsqueeze(-1), 1)
        surplus = data.reward - self.model.predict(data.observation, data.action, doubt=False).reward
        self._ends = Ends(kernels[0], others, self._scaled(data.following), data.terminated, surplus)
        self._seen = torch.cat([others, self._ends.scaled], 1)
        eye = torch.eye(self._seen.shape[1], dtype=others.dtype, device=others.device)
        self._novelty_factor = cholesky(kernels[1](self._seen, self._seen) + NOVELTY_NOISE * eye)

    def _novelty(self, observation: Tensor) -> Float[Tensor, "L N"]:
        """How little observations look like visited states, 0 to 1."""
        cross = self._novelty_kernel(self._seen, self._scaled(observation))
        known = torch.linalg.solve_triangular(self._novelty_factor, cross, upper=False)
        return (1 - known.square().sum(-2)).clamp(0, 1)

    def _choose(self, data: Transitions, uniform: Tensor) -> Float[Tensor, "L M S"]:
        """Support states that cover visited and imagined ones, none of them an end."""
        visited = data.observation
        known = visited if self._support is None else torch.cat([visited, self._support.observation], 1)
        start = (uniform[..., 0] * known.shape[1]).long()
        imagined = known.take_along_dim(start.unsqueeze(-1), 1)
        for action in (2 * uniform[..., 1:] - 1).chunk(IMAGINED_STEPS, -1):
            imagined = self.model.predict(imagined, action, doubt=False).observation
        pool = torch.cat([known, imagined], 1)
        over = (self._ends.judge(self._scaled(pool))[0] > 0.5).unsqueeze(-1)
        pool = torch.where(over, visited[:, -1:], pool)  # visited states that are no ends fill the places
        chosen = farthest_points(self._scaled(pool), self.planning.support).chosen
        return pool.take_along_dim(chosen.unsqueeze(-1), 1)

    def _iterate(self, values: Tensor, sweeps: int) -> None:
        """Value iteration at the support."""
        support, actions = self._support, self._backup_actions
        assert support is not None
        learners, count, _ = support.observation.shape
        spread = support.observation.repeat_interleave(len(actions), 1)
        course = self._course(spread, actions.repeat(count, 1).expand(learners, -1, -1), doubt=True)
        unknown, weight = self._unknown(course), self._beyond * course.lasting.unsqueeze(-1)
        cross = self._kernel(self._scaled(course.observation), support.scaled)
        eye = torch.eye(support.scaled.shape[1], dtype=cross.dtype, device=cross.device)
        factor = cholesky(self._kernel(support.scaled, support.scaled) + VALUE_NOISE * eye)
        lowest, highest = self._range()
        trembling = trembling_weights(actions, self.planning.tremble)
        for _ in range(sweeps):
            weights = torch.cholesky_solve(self._residual(values), factor)
            beyond = torch.clamp(cross @ weights + support.prior, lowest, highest)
            backup = course.reward.unsqueeze(-1) + weight * beyond
            backup = torch.lerp(backup, highest.expand_as(backup), unknown)
            values = (trembling @ backup.unflatten(1, (count, -1))).amax(2)
        weights = torch.cholesky_solve(self._residual(values), factor)
        self._support = support._replace(weights=weights)

    @property
    def _beyond(self) -> float:
        """Discount of what comes after an action."""
        return self.planning.discount**self.planning.hold

    def _course(self, observation: Tensor, action: Tensor, doubt: bool) -> Course:
        """What holding actions leads to."""
        reward, lasting = torch.zeros_like(observation[..., 0]), torch.ones_like(observation[..., 0])
        unsure = reward
        for held in range(self.planning.hold):
            step, end = self._step(observation, action, doubt and not held)
            observation, unsure = step.observation, unsure + step.doubt  # about the first step
            reward = reward + self.planning.discount**held * lasting * step.reward
            lasting = lasting * (1 - end)
        return Course(observation, reward, lasting, unsure)

    def _step(
        self, observation: Tensor, action: Tensor, doubt: bool, margin: float = MARGIN
    ) -> tuple[Prediction, Tensor]:
        """What a step leads to, with what an end pays; and how far that looks like an end [L, N], 0 to 1."""
        step = self.model.predict(observation, action, doubt, margin)
        end, prize = self._ends.judge(self._scaled(step.observation))
        return step._replace(reward=step.reward + prize), end

    def _residual(self, values: Tensor) -> Tensor:
        """Values at the support less their prior mean; at ends the value is zero."""
        support = self._support
        assert support is not None
        at_ends = torch.where(
            support.ends.unsqueeze(-1) > 0.5, -support.prior, torch.zeros_like(support.prior)
        )
        return torch.cat([values - support.prior, at_ends.expand(-1, support.ends.shape[1], -1)], 1)

    def _unknown(self, course: Course) -> Float[Tensor, "L N 2"]:
        """Share of a backup that is not known, for both values; zero for the one that exploits."""
        new = torch.maximum(course.doubt, self._novelty(course.observation) * course.lasting)
        return torch.stack([torch.zeros_like(new), new], -1)

    def _range(self) -> tuple[Float[Tensor, "L 1 1"], Float[Tensor, "L 1 2"]]:
        """Lowest and highest of both values."""
        return self._low.unsqueeze(-1), torch.stack([self._high, self._hope], -1)

    def _values_of(self, support: Support, observation: Tensor) -> Float[Tensor, "L N 2"]:
        unit = self.planning.lengthscale * math.sqrt(observation.shape[-1])
        scaled = (observation - support.loc) / (support.scale * unit)
        values = self._kernel(scaled, support.scaled) @ support.weights + support.prior
        return torch.clamp(values, *self._range())

    # ---------------------------------------------------------------- acting

    @torch.no_grad()
    def action_values(
        self, observation: Float[Tensor, "L N S"], action: Float[Tensor, "L N A"], explore: bool
    ) -> Float[Tensor, "L N"]:
        """r̂ + γ V(ŝ') of actions in halves of the actuator's range, each held for `Planning.hold` steps."""
        support = self._support
        assert support is not None
        course = self._course(observation, action, doubt=explore)
        after = self._values_of(support, course.observation)[..., EXPLORE if explore else EXPLOIT]
        value = course.reward + self._beyond * course.lasting * after
        if not explore:
            return value
        return torch.lerp(value, self._hope.expand_as(value), self._unknown(course)[..., EXPLORE])

    def best_action(self, observation: Float[Tensor, "L N S"], explore: bool) -> Float[Tensor, "L N A"]:
        """What to do, in halves of the actuator's range: to explore, or what is performed."""

        def planned(states: Tensor) -> Tensor:
            return self._best_of(self.acting_actions, states, explore)

        if explore or self._performance is None:
            return planned(observation)
        return self._performance.action(observation, planned)

    @torch.no_grad()
    def course(
        self, observation: Float[Tensor, "L N S"], last: Float[Tensor, "L N H A"] | None = None
    ) -> Float[Tensor, "L N H A"]:
        """What to do now and in the next steps, in halves of the actuator's range (`look_ahead`).

        Args:
            observation: the states.
            last: a course to go on with; that of what is performed unless told.
        """
        planning, walks = self.planning, self._walks(observation, self.planning.look_ahead)
        ahead = LookAhead(walks.step, walks.value, self._roughly_performed, planning.discount, walks.steps)
        varied = variations(planning.variations, walks.steps, len(self._half))
        each = len(observation) * (len(varied) + 2) * (self.model.budget + planning.support)
        return ahead.course(observation, last, varied, max(1, CHUNK // each))

    def _roughly_performed(self, states: Tensor) -> Float[Tensor, "L N A"]:
        """What is performed without looking ahead, out of fewer actions."""
        planned = partial(self._best_of, self._backup_actions, explore=False)
        return planned(states) if self._performance is None else self._performance.action(states, planned)

    @property
    def looks_ahead(self) -> bool:
        """Whether anybody looks ahead before acting: not who has settled on what is performed."""
        settled = self._performance is not None and self._performance.all_settled
        return self.planned and self.planning.look_ahead > 0 and not settled

    def _best_of(
        self, actions: Float[Tensor, "J A"], states: Tensor, explore: bool
    ) -> Float[Tensor, "L N A"]:
        return actions[self._values_of_actions(states, actions, explore).argmax(-1)]

    @torch.no_grad()
    def candidate_values(self, observation: Float[Tensor, "L N S"], explore: bool) -> Float[Tensor, "L N J"]:
        """The values of all actions compared when acting [J], each averaged over actions near it."""
        return self._values_of_actions(observation, self.acting_actions, explore)

    def _values_of_actions(
        self, observation: Tensor, actions: Float[Tensor, "J A"], explore: bool
    ) -> Float[Tensor, "L N J"]:
        trembling = trembling_weights(actions, self.planning.tremble)
        each = len(observation) * len(actions) * (self.model.budget + self.planning.support)
        values = []
        for some in observation.split(max(1, CHUNK // each), 1):
            spread = some.repeat_interleave(len(actions), 1)
            tried = actions.repeat(some.shape[1], 1).expand(len(some), -1, -1)
            value = self.action_values(spread, tried, explore)
            values.append(value.unflatten(1, (some.shape[1], -1)) @ trembling.mT)
        return torch.cat(values, 1)

    @torch.no_grad()
    def reward(
        self, observation: Float[Tensor, "L N S"], action: Float[Tensor, "L N A"]
    ) -> Float[Tensor, "L N"]:
        """The reward expected of one step, with what an end pays; actions in halves of their range."""
        return self._step(observation, action, doubt=False)[0].reward

    @torch.no_grad()
    def unknown(
        self, observation: Float[Tensor, "L N S"], action: Float[Tensor, "L N A"]
    ) -> Float[Tensor, "L N"]:
        """The share, 0 to 1, of what actions lead to that the experience says nothing about.

        Args:
            observation: the states.
            action: in halves of the actuator's range.
        """
        step = self.model.predict(observation, action)
        return torch.maximum(step.doubt, self._novelty(step.observation))

    def value(self, observation: Float[Tensor, "L N S"], action: Float[Tensor, "L N A"]) -> Posterior:
        """Action values [L, N] of actions in the actuator's units, in units of the return.

        The variance is what the model's doubt is worth: that share of the squared attainable range.
        """
        observation = observation.to(self.model.loc.dtype)
        share = (action.to(observation) - self._centre) / self._half
        mean = self.action_values(observation, share, explore=False)
        return Posterior(mean, self.unknown(observation, share) * (self._high - self._low).square())

    def basis_points(self, learner: int) -> Float[Tensor, "M S"]:
        """The support states of a learner, as observations."""
        assert self._support is not None
        return self._support.observation[learner]

    # ---------------------------------------------------------------- keeping

    def state_dict(self) -> dict[str, Any]:
        """The plan and what is performed; what judges states follows from the experience."""
        if self._support is None:
            return {}
        state: dict[str, Any] = {"support": self._support._asdict()}
        if self._performance is not None:
            state["performance"] = self._performance.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any], data: Transitions) -> None:
        """Take up what `state_dict` gave, with the experience that was planned on."""
        if state:
            self._judge(data, self._kernels(data.observation))
            self._low, self._high, self._hope = attainable(data, self.planning)
            self._support = Support(**state["support"])
        if "performance" in state:
            self._performance = Performance.restored(state["performance"])
