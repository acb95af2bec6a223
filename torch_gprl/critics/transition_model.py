"""What a step leads to, learned: next observation and reward as Gaussian processes.

    ŝ' = s + f(s, a),   r̂ = ρ(ŝ', a)

Differences of observations, and rewards, have as their prior a squared exponential for the bends plus a
linear kernel for what mechanics makes of small steps (Deisenroth, Fox and Rasmussen, 2015, learn the same
differences). The reward is learned as a function of where the step leads: rewards for places then depend on
places alone, which the fit finds out, and noise on the way does not blur them. Inputs and targets are
standardised by the data. Rewards are those of steps that go on; what ends pay is learned in `ends`.
"""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import LogNormal

from torch_gprl.gp import SparseRegression
from torch_gprl.graphs import farthest_points
from torch_gprl.kernels import Kernel, Linear, SquaredExponential
from torch_gprl.linalg import CholeskyError, cholesky

FIRST_NOISE, NOISE_FLOOR = 1e-3, 1e-5  # variances, of standardised targets
FIT_RATE = 0.1  # of Adam, in log hyper-parameters
MARGIN = 0.1  # predictions stay in the range of what was seen, widened by this share on either side


class Transitions(NamedTuple):
    """Experience of learners, N steps each.

    Attributes:
        observation: [L, N, S] before the step.
        action: [L, N, A] in halves of the actuator's range, from −1 to 1.
        reward: [L, N].
        following: [L, N, S] observation after the step.
        terminated: [L, N] 1 where the step ended the task, else 0; time limits are no ends.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    following: Tensor
    terminated: Tensor


class Prediction(NamedTuple):
    """What is expected of steps.

    Attributes:
        observation: [L, N, S] after the step.
        reward: [L, N] as of a step that does not end the task.
        doubt: [L, N] the share, 0 to 1, of the prior variance of the bends that data have not removed.
    """

    observation: Tensor
    reward: Tensor
    doubt: Tensor


class Fit(NamedTuple):
    """How hyper-parameters are fitted.

    Attributes:
        points: data at most.
        steps: of the optimiser.
        lengthscale: to begin with, in standard deviations of the inputs.
    """

    points: int
    steps: int
    lengthscale: float


SMOOTH = Fit(100, 100, 2.0)
SHARP = Fit(200, 100, 0.7)  # from long length scales, what is rare and narrow seems noise, and stays so


class Regressor:
    """Standardised targets as functions of the same inputs: kernel, noise, and what the data say.

    Args:
        learners: L, how many.
        columns: D, of the inputs.
        budget: basis vectors.
        sharp: whether targets may change much between near inputs. Data to fit to, and basis vectors, then
            lie apart in targets as well, or a reward that was met a few times would be smoothed away.
    """

    def __init__(self, learners: int, columns: int, budget: int, sharp: bool = False) -> None:
        batch = (learners,)
        self.budget, self.sharp, self._how = budget, sharp, SHARP if sharp else SMOOTH
        self.bends = SquaredExponential(columns, self._how.lengthscale, batch_shape=batch)
        self.bends.set_prior("lengthscale", LogNormal(math.log(2.0), 1.0))
        self.bends.set_prior("outputscale", LogNormal(0.0, 2.0))
        slopes = Linear(columns, 0.4, 0.4, batch_shape=batch)
        slopes.set_prior("slope_variance", LogNormal(-1.0, 2.0))
        slopes.set_prior("bias_variance", LogNormal(-1.0, 2.0))
        self.kernel: Kernel = self.bends + slopes
        self.log_noise = torch.full(batch, math.log(FIRST_NOISE), dtype=torch.float64)
        self._first = [value.detach().clone() for value in (*self.kernel.parameters(), self.log_noise)]

    def solve(self, inputs: Float[Tensor, "L N D"], targets: Float[Tensor, "L N T"], fit: bool) -> None:
        """Learn all data anew, with new hyper-parameters if asked."""
        self._target_loc, self._target_scale = moments(targets)
        targets = (targets - self._target_loc) / self._target_scale
        if fit:
            some = self._spread(inputs, targets)
            self._fit(inputs.take_along_dim(some, 1), targets.take_along_dim(some, 1))
        basis = inputs.take_along_dim(self._apart(inputs, targets, self.budget), 1)
        self._regression = SparseRegression(self.kernel, basis, inputs, targets, self.log_noise.exp())

    def _spread(self, inputs: Tensor, targets: Tensor) -> Int[Tensor, "L M 1"]:
        """Data to fit hyper-parameters to."""
        if self.sharp:
            return self._apart(inputs, targets, self._how.points)
        steps = inputs.shape[1]
        spaced = torch.linspace(0, steps - 1, min(self._how.points, steps), device=inputs.device)
        return spaced.long().view(1, -1, 1).expand(len(inputs), -1, -1)

    def _apart(self, inputs: Tensor, targets: Tensor, count: int) -> Int[Tensor, "L M 1"]:
        """Data that lie apart."""
        places = inputs / self.bends.lengthscale.detach().unsqueeze(-2)
        if self.sharp:
            places = torch.cat([places, targets], -1)
        return farthest_points(places, count).chosen.unsqueeze(-1)

    def mean(self, inputs: Float[Tensor, "L N D"]) -> Float[Tensor, "L N T"]:
        """Expected targets."""
        return self._regression.mean(inputs) * self._target_scale + self._target_loc

    def doubt(self, inputs: Float[Tensor, "L N D"]) -> Float[Tensor, "L N"]:
        """The share, 0 to 1, of the prior variance of the bends that data have not removed."""
        left = self._regression.variance(inputs) / self.bends.outputscale.detach().unsqueeze(-1)
        return left.clamp(max=1.0)

    def _fit(self, inputs: Tensor, targets: Tensor) -> None:
        """Maximise the evidence of all targets together, afresh: what little data said can mislead.

        A learner keeps what it has where that explains the data better.
        """
        parameters = [*self.kernel.parameters(), self.log_noise]
        before = [value.detach().clone() for value in parameters]
        self.log_noise.requires_grad_(True)
        optimiser = torch.optim.Adam(parameters, lr=FIT_RATE)
        better = torch.zeros(len(inputs), dtype=torch.bool, device=inputs.device)
        try:
            with torch.no_grad():
                evidence = self._log_evidence(inputs, targets)
                for value, first in zip(parameters, self._first, strict=True):
                    value.copy_(first)
            for _ in range(self._how.steps):
                optimiser.zero_grad()
                (-self._log_evidence(inputs, targets).sum()).backward()
                optimiser.step()
                self.log_noise.data.clamp_(min=math.log(NOISE_FLOOR))
            better = self._log_evidence(inputs, targets).detach() >= evidence
        except CholeskyError:
            pass  # nobody's are better
        with torch.no_grad():
            for value, old in zip(parameters, before, strict=True):
                value.copy_(torch.where(better.view(-1, *[1] * (value.ndim - 1)), value, old))
        self.log_noise.requires_grad_(False)

    def _log_evidence(self, inputs: Tensor, targets: Tensor) -> Float[Tensor, " L"]:
        noise = self.log_noise.exp()[:, None, None]
        gram = self.kernel(inputs, inputs)
        factor = cholesky(gram + noise * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device))
        white = torch.linalg.solve_triangular(factor, targets, upper=False)
        volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        misfit = 0.5 * white.square().sum((-2, -1)) + targets.shape[-1] * volume
        return self.kernel.log_prior() - misfit - 0.125 * (self.log_noise - math.log(FIRST_NOISE)).square()

    def state_dict(self) -> dict[str, Any]:
        """The hyper-parameters; the rest follows from the data."""
        return {"kernel": self.kernel.state_dict(), "log_noise": self.log_noise.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.kernel.load_state_dict(state["kernel"])
        self.log_noise.copy_(state["log_noise"])


class TransitionModel:
    """Predicts steps, for each learner from its own experience.

    Differences of observations share one regressor; the reward, which may jump where mechanics is smooth,
    has its own.

    Args:
        learners: L, how many.
        states: S, size of an observation.
        actions: A, size of an action.
        budget: basis vectors of each regressor.
    """

    def __init__(self, learners: int, states: int, actions: int, budget: int) -> None:
        self.budget = budget
        self.motion = Regressor(learners, states + actions, budget)
        self.reward = Regressor(learners, states + actions, budget, sharp=True)

    def solve(self, data: Transitions, fit: bool) -> None:
        """Learn all experience anew, with new hyper-parameters if asked."""
        seen = torch.cat([data.observation, data.following], 1)
        self.loc, self.scale = moments(data.observation)
        self._low, self._high = seen.amin(1, keepdim=True), seen.amax(1, keepdim=True)
        inputs = self.inputs(data.observation, data.action)
        self.motion.solve(inputs, data.following - data.observation, fit)
        ended = data.terminated > 0.5
        # what ends pay is no part of the reward on the way: a step that went on stands in for each of them
        index = torch.arange(ended.shape[1], device=ended.device).expand_as(ended)
        index = torch.where(ended, ended.int().argmin(1, keepdim=True), index)
        reward = data.reward.gather(1, index).unsqueeze(-1)
        self._reward_low, self._reward_high = reward.amin(1), reward.amax(1)
        inputs = self.inputs(data.following, data.action)
        self.reward.solve(inputs.take_along_dim(index.unsqueeze(-1), 1), reward, fit)

    def inputs(self, observation: Tensor, action: Tensor) -> Float[Tensor, "L N D"]:
        """Standardised observations beside actions."""
        return torch.cat([(observation - self.loc) / self.scale, action], -1)

    def predict(
        self, observation: Tensor, action: Tensor, doubt: bool = True, margin: float = MARGIN
    ) -> Prediction:
        """What steps lead to, near what was seen; differentiable in both, but for the doubt.

        Args:
            observation: [L, N, S].
            action: [L, N, A], in halves of the actuator's range.
            doubt: whether doubt about the motion is computed, at several times the cost; else it is zero.
            margin: share by which predictions may leave the range of what was seen, on either side.
        """
        inputs = self.inputs(observation, action)
        beyond = margin * (self._high - self._low)
        following = observation + self.motion.mean(inputs)
        following = torch.clamp(following, self._low - beyond, self._high + beyond)
        reward = self.reward.mean(self.inputs(following, action)).squeeze(-1)
        reward = torch.clamp(reward, self._reward_low, self._reward_high)
        unsure = self.motion.doubt(inputs) if doubt else torch.zeros_like(reward)
        return Prediction(following, reward, unsure)

    def state_dict(self) -> dict[str, Any]:
        """The hyper-parameters; the rest follows from the experience."""
        return {"motion": self.motion.state_dict(), "reward": self.reward.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.motion.load_state_dict(state["motion"])
        self.reward.load_state_dict(state["reward"])


def moments(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation over the data [L, 1, columns]; 1 for a column that never changes."""
    std = values.std(1, keepdim=True)
    return values.mean(1, keepdim=True), torch.where(std > 1e-9, std, 1.0)
