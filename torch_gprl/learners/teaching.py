"""How the critic of a policy-gradient learner is taught: targets, renewal, replay, pruning (Claim 2).

A critic lives through policy updates. What it learned under older policies is out of date, and is forgotten
by renewal, by pruning that prefers young basis vectors, or by solving the temporal differences of a replay
buffer anew under today's policy.
"""

import math
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torch_gprl.critics import (
    GPActionValue,
    action_value_kernel,
    clear_graphs,
    follow_basis,
    graphs,
    store_transitions,
    suit_graphs,
)
from torch_gprl.critics.difference_equations import Transitions
from torch_gprl.gp import AgeAwareScore, InformationScore, SparseOnlineGP, fit_hyperparameters
from torch_gprl.graphs.covering import farthest_points
from torch_gprl.learners.config import PolicyGradientConfig
from torch_gprl.learners.experience import Experience
from torch_gprl.policies import GaussianPolicy

FIT_POINTS = 160  # points of a rollout that a fit of hyper-parameters sees; its cost is cubic in them
LEAST_FIT_POINTS = 8  # that a fit can be asked for
TUNING_NODES = 60  # of a graph of basis vectors while its kernel is fitted
FIRST_FIT, LATER_FITS = 50, 20  # steps of the optimiser: later fits start from the last
GRAPH_FITS_SHORTER = 4  # times: a graph is searched anew at every step
RENEWED_SHARE = 0.2  # of all experience that is new when scaling and basis are chosen anew
IMPROVED_STATES = 256  # of all experience, for steps of the policy without a new rollout
FIRST_NOISE = 0.05  # noise variance of standardised targets before the first fit
REMEMBERED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
)
T = TypeVar("T", Tensor, TensorDictBase)


def make_critic(policy: GaussianPolicy, config: PolicyGradientConfig, learners: int) -> GPActionValue:
    """An empty critic of a policy, one Gaussian process for each learner."""
    head = policy.head
    states, actions = head.controller.observation_dim, head.controller.action_dim
    lengthscale = _lengthscale(states, actions, config)
    if config.targets == "returns":  # fitted from the first rollout on
        lengthscale.fill_(1)
    # a basis overshoots its budget by a quarter at most
    capacity = config.budget + config.budget // 4 + 1 if config.kernel == "shortest-path" else config.visited
    kernel = action_value_kernel(config.kernel, lengthscale, actions, learners, config.discount, capacity)
    pruning = InformationScore()
    if config.age_weight:
        pruning = AgeAwareScore(config.age_weight, config.age_form, config.age_timescale)
    if config.targets == "differences":
        kernel.requires_grad_(False)
    gp = SparseOnlineGP(kernel, config.budget, FIRST_NOISE, config.novelty_threshold, pruning=pruning)
    low, high = head.centre - head.half_range, head.centre + head.half_range
    return GPActionValue(gp, action_low=low, action_high=high)


class Teacher:
    """Teaches the critic rollout by rollout.

    Args:
        critic: what is taught.
        policy: whose values it should learn.
        config: targets, renewal, replay.
    """

    def __init__(self, critic: GPActionValue, policy: GaussianPolicy, config: PolicyGradientConfig) -> None:
        self.critic, self.config = critic, config
        self.policy: ProbabilisticTensorDictSequential = policy
        self.experience = Experience(config.replay) if config.replay else None
        self.fresh = 0  # transitions of each learner since the basis was chosen
        self.solved: Int[Tensor, "learners steps"] | None = None  # rows of the experience; None: all of them

    def teach(self, rollout: TensorDictBase, update: int) -> None:
        """Absorb a rollout [learners, envs, T] with `value_target`, made at policy update `update`."""
        if self.experience is None:
            self._learn_on(rollout, update)
        else:
            self._remember(rollout)
            follow_basis(self.critic)
            self.solve_anew()

    def _learn_on(self, rollout: TensorDictBase, update: int) -> None:
        """Add a rollout to what is known; first renew at updates 0, 1, 2, 4, ... and every `renew_every`."""
        config = self.config
        young = update & (update - 1) == 0  # a power of two: values change fast at first
        if update % config.renew_every == 0 or (young and update < config.renew_every):
            self._renew(rollout, update)
        store_transitions(self.critic, rollout, self.policy)
        if config.targets == "returns":
            self.critic.update(rollout, stamp=update)
        else:
            self.critic.update_differences(rollout, self.policy, config.discount, stamp=update)
        follow_basis(self.critic)

    def _remember(self, rollout: TensorDictBase) -> None:
        """Add a rollout to the experience; where much of it is new, scale and cover it anew."""
        assert self.experience is not None
        transitions = rollout.select(*REMEMBERED).reshape(rollout.shape[0], -1)
        self._choose_solved(self.experience.extend(transitions))
        self.fresh += transitions.shape[1]
        if self.fresh < RENEWED_SHARE * len(self.experience):
            store_transitions(self.critic, rollout, self.policy)
            return
        self.fresh, critic, remembered = 0, self.critic, self._remembered()
        observation, action = remembered.get("observation"), remembered.get("action")
        critic.standardise(observation, action, remembered.get(("next", "reward")))
        self._scale_values(remembered)
        clear_graphs(critic)
        store_transitions(critic, self.experience.all(), self.policy)
        dims = observation.shape[-1], action.shape[-1]
        critic.cover(observation, action, _lengthscale(*dims, self.config).to(critic.input_loc))

    def _remembered(self) -> TensorDictBase:
        """What is solved of the experience, [learners, steps]."""
        assert self.experience is not None
        every = self.experience.all()
        if self.solved is None:
            return every
        some = every.gather(1, self.solved)
        assert isinstance(some, TensorDictBase)
        return some

    def _choose_solved(self, new: Int[Tensor, " N"]) -> None:
        """Of what was solved so far and the new rows of the experience, keep those farthest from each other.

        A policy that does well visits little. Thinned evenly, most of what is kept would be there, and errors
        of the values elsewhere would end in a relapse.
        """
        assert self.experience is not None
        count, every = self.config.solved, self.experience.all()
        learners, steps = every.batch_size
        if steps <= count:
            return
        if self.solved is None:
            rows = torch.arange(steps, device=every.get("action").device).expand(learners, -1)
        else:
            rows = torch.cat([self.solved, new.to(self.solved.device).expand(learners, -1)], 1)
        chosen = self._farthest_apart(every.gather(1, rows), count)
        self.solved = rows.gather(1, chosen.sort(-1).values)

    def _farthest_apart(self, transitions: TensorDictBase, count: int) -> Int[Tensor, "learners count"]:
        """Rows of transitions [learners, N] whose (s, a) lie farthest apart, in standard deviations."""
        inputs = self.critic.inputs(transitions.get("observation"), transitions.get("action"))
        spread = inputs.std(-2, keepdim=True)
        return farthest_points(inputs / torch.where(spread > 1e-6, spread, 1.0), count).chosen

    @torch.no_grad()
    def _scale_values(self, remembered: TensorDictBase) -> None:
        """The prior of values by the moments of the reward: where nothing is known they stay at its mean."""
        critic, rest = self.critic, 1 - self.config.discount
        mean, variance = Transitions.of(remembered, critic.input_loc).reward_moments()
        critic.target_loc.copy_(mean / rest)
        critic.target_scale.copy_(torch.where(variance > 0, variance.sqrt(), 1.0) / rest)
        critic.gp.log_noise_variance.fill_(math.log(self.config.noise * rest**2))

    def solve_anew(self) -> None:
        """Solve the differences of experience under today's policy."""
        self.critic.resolve(self._remembered(), self.policy, self.config.discount)

    def landmarks(self) -> TensorDictBase:
        """Remembered transitions that lie farthest apart [learners, 1, states], to improve the policy at.

        Most of a good policy's experience is from where it stays. A mean over all of it would leave the
        policy free, within any trust region, to forget what to do elsewhere.
        """
        remembered = self._remembered()
        chosen = remembered.gather(1, self._farthest_apart(remembered, IMPROVED_STATES))
        assert isinstance(chosen, TensorDictBase)
        return chosen.unsqueeze(1)

    def _renew(self, rollout: TensorDictBase, update: int) -> None:
        """Forget, and set scaling and hyper-parameters by this rollout."""
        critic, gp = self.critic, self.critic.gp
        data = rollout.get("observation"), rollout.get("action")
        critic.standardise(*data, rollout.get("value_target"))
        clear_graphs(critic)
        if self.config.targets == "differences":
            reward = rollout.get(("next", "reward")).flatten(1).to(gp.basis.dtype)
            # rewards without spread would leave no noise at all
            variance = (reward.var(1) / critic.target_scale.square()).clamp_min(1e-6)
            with torch.no_grad():
                gp.log_noise_variance.copy_((self.config.noise * variance).log())
            return
        self._fit(rollout, FIRST_FIT if update == 0 else LATER_FITS)

    def _fit(self, rollout: TensorDictBase, steps: int) -> None:
        """Hyper-parameters by this rollout; on a graph of one half of it by the other.

        A graph tells more of the states that it stands on than of new ones.
        """
        critic, points = self.critic, rollout
        on_graph = any(True for _ in graphs(critic))
        if on_graph:
            stored, points = rollout.chunk(2, dim=1 if rollout.shape[1] > 1 else 2)
            store_transitions(critic, stored, self.policy)
            states = critic.inputs(stored.get("observation"), stored.get("action"))
            follow_basis(critic, _spread_over(states, min(TUNING_NODES, self.config.budget)))
        inputs = critic.inputs(points.get("observation"), points.get("action"))
        targets = critic.standard_targets(points.get("value_target"))
        if inputs.shape[1] >= LEAST_FIT_POINTS:  # fewer tell nothing: the first guess, or the last fit, stays
            inputs, targets = _spread_over(inputs, FIT_POINTS), _spread_over(targets, FIT_POINTS)
            if not suit_graphs(critic, inputs, targets, steps):
                shorter = GRAPH_FITS_SHORTER if on_graph else 1
                fit_hyperparameters(critic.gp, inputs, targets, steps // shorter)
        clear_graphs(critic)

    def figures(self) -> dict[str, Tensor]:
        """Basis vectors in use, and the share of them that is older than the newest experience [learners]."""
        gp = self.critic.gp
        outdated = ((gp.stamps < gp.clock) & gp.mask).sum(-1) / gp.size.clamp_min(1)
        return {"basis_size": gp.size.clone(), "outdated": outdated}

    def state_dict(self) -> dict[str, Any]:
        """Critic and replay."""
        return {
            "critic": self.critic.state_dict(),
            "experience": None if self.experience is None else self.experience.state_dict(),
            "fresh": self.fresh,
            "solved": self.solved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.critic.load_state_dict(state["critic"])
        if self.experience is not None:
            self.experience.load_state_dict(state["experience"])
        self.fresh, self.solved = state["fresh"], state["solved"]


def _lengthscale(states: int, actions: int, config: PolicyGradientConfig) -> Float[Tensor, " D"]:
    """Of the columns of observations, then of those of actions."""
    lengthscale = torch.full((states + actions,), config.action_lengthscale, dtype=torch.float64)
    lengthscale[:states] = config.lengthscale * math.sqrt(states)
    return lengthscale


def _spread_over(data: T, count: int) -> T:
    """So many rows of data [learners, N, ...], evenly spread over all."""
    rows = torch.linspace(0, data.shape[1] - 1, min(count, data.shape[1])).long()
    return data[:, rows]  # pyright: ignore[reportReturnType]
