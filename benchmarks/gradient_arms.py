"""Gradient estimators under comparison: critics fitted on an earlier batch, used on a new one."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor

from benchmarks.gradient_data import EPISODES, STEPS, Batches
from torch_gprl.critics import (
    ESTIMATORS,
    USE_ALL_ACTIONS,
    EstimatorName,
    Evaluation,
    GPActionValue,
    GPValueEstimator,
)
from torch_gprl.learners import PolicyGradientConfig
from torch_gprl.learners.neural_value import NeuralTeacher, NeuralValue
from torch_gprl.learners.teaching import Teacher, make_critic
from torch_gprl.objectives import AllActionLoss, PolicyGradientLoss
from torch_gprl.policies import GaussianPolicy


@dataclass(frozen=True)
class Arm:
    """An estimator, and the critic behind it.

    Critics are "none", "neural", and Gaussian processes: "returns" and "differences" learned one earlier
    batch, those of `REPLAYED` solved the differences of several, and "pooled" those of so many that next to
    nothing is unknown. What the last one leaves is the noise of the few states in a batch, which no critic
    can help; averages over all actions at all `remembered` states, those of the earlier batches too, have
    less of it.
    """

    label: str
    critic: str
    estimator: EstimatorName
    horizon: int = 1
    trace: float = 0.95
    remembered: bool = False


ARMS = (
    Arm("REINFORCE, full return", "none", "return"),
    Arm("return to go", "none", "reward-to-go"),
    Arm("return − batch mean", "none", "mean-baseline"),
    Arm("return − optimal constant", "none", "optimal-baseline"),
    Arm("(.7) as printed, k = 10", "returns", "k-step", 10),
    Arm("k = 10 with baseline", "returns", "k-step-baseline", 10),
    Arm("return − neural V", "neural", "value-baseline"),
    Arm("return − V_GP", "returns", "value-baseline"),
    Arm("neural GAE, λ = 0", "neural", "generalised", trace=0.0),
    Arm("neural GAE, λ = 0.5", "neural", "generalised", trace=0.5),
    Arm("neural GAE, λ = 0.8", "neural", "generalised", trace=0.8),
    Arm("neural GAE, λ = 0.95", "neural", "generalised", trace=0.95),
    Arm("GPTD control variate", "differences", "control-variate"),
    Arm("GPTD GAE, λ = 0.5", "differences", "generalised", trace=0.5),
    Arm("GPTD GAE, λ = 0.8", "differences", "generalised", trace=0.8),
    Arm("GPTD, k = 1, minus V", "differences", "k-step-baseline", 1),
    Arm("GPTD advantage", "differences", "advantage"),
    Arm("GPTD all-action", "differences", "all-action"),
    Arm("GPTD GAE, λ = 0.8, replay", "five", "generalised", trace=0.8),
    Arm("GPTD all-action, replay", "five", "all-action"),
    Arm("5 batches, remembered states", "five", "all-action", remembered=True),
    Arm("10 batches, remembered states", "ten", "all-action", remembered=True),
    Arm("20 batches, remembered states", "twenty", "all-action", remembered=True),
    Arm("all-action, best critic", "pooled", "all-action"),
)
REPLAYED = {"five": 5, "ten": 10, "twenty": 20}  # batches, by the critic that solves their differences
POOLED = 40  # batches
GAUSSIAN = ("returns", "differences", *REPLAYED, "pooled")  # processes as critics
AT_ONCE = {"targets": "differences", "lengthscale": 0.5, "noise": 0.001}  # where all differences are solved
STEPS_PER_BASIS_VECTOR, LARGEST_BASIS = 5, 1_000  # where all differences are solved


class Critics(NamedTuple):
    """One critic of each kind for each learner."""

    gaussian: dict[str, GPActionValue]
    neural: NeuralValue


def fit_critics(
    earlier: Batches, several: Batches | None, pooled: GPActionValue, numbers: PolicyGradientConfig
) -> Critics:
    """All critics: fitted on one earlier batch for each learner, on several, and the one that serves all.

    Args:
        earlier: one batch for each learner.
        several: as many as the largest of `REPLAYED` for each learner; none, and no critic learns them.
        pooled: critic of very many batches.
        numbers: of the critics that learn one batch.
    """
    gaussian = {
        "returns": fit_gaussian(earlier, numbers),
        "differences": fit_gaussian(earlier, dataclasses.replace(numbers, targets="differences")),
    }
    if several is not None:
        for name, count in REPLAYED.items():
            replayed = first(several, count)
            gaussian[name] = fit_gaussian(replayed, at_once(replayed, numbers))
    gaussian["pooled"] = pooled
    return Critics(gaussian, fit_neural(earlier, numbers))


def fit_neural(earlier: Batches, numbers: PolicyGradientConfig) -> NeuralValue:
    """A neural state value, taught as the learner teaches it; twice, to bootstrap where episodes are cut."""
    data, critic = earlier.data.clone(), NeuralValue(earlier.data["observation"].shape[-1], len(earlier.data))
    teacher = NeuralTeacher(critic)
    estimator = GPValueEstimator(critic, earlier.policy, numbers.discount, "generalised", STEPS)
    for round_ in range(2):
        teacher.teach(estimator(data), round_)
    return critic.requires_grad_(False)


def fit_pooled(batch: Batches, numbers: PolicyGradientConfig, learners: int) -> GPActionValue:
    """One critic that has learned a very large batch of one learner, repeated for all learners."""
    config = at_once(batch, numbers)
    one = fit_gaussian(batch, config)
    critic = make_critic(batch.policy, config, learners)
    own = critic.state_dict()
    critic.load_state_dict({key: value.expand_as(own[key]) for key, value in one.state_dict().items()})
    return critic.requires_grad_(False)


def first(several: Batches, count: int) -> Batches:
    """So many of each learner's batches."""
    kept = slice(count * EPISODES)
    return Batches(several.data[:, kept], several.true_return[:, kept], several.policy)


def at_once(earlier: Batches, numbers: PolicyGradientConfig) -> PolicyGradientConfig:
    """Numbers of a critic that solves all differences of these batches, on a basis that grows with them."""
    steps = earlier.data[0].numel()
    budget = min(LARGEST_BASIS, max(1, steps // STEPS_PER_BASIS_VECTOR))
    return dataclasses.replace(numbers, replay=steps, solved=steps, budget=budget, **AT_ONCE)


def fit_gaussian(earlier: Batches, config: PolicyGradientConfig) -> GPActionValue:
    """A Gaussian-process critic, taught as the learner teaches it."""
    critic = make_critic(earlier.policy, config, earlier.data.shape[0])
    data = GPValueEstimator(critic, earlier.policy, config.discount, horizon=STEPS)(earlier.data.clone())
    Teacher(critic, earlier.policy, config).teach(data, 0)
    return critic.requires_grad_(False)


def evaluations(new: Batches, critics: Critics, discount: float) -> dict[str, Evaluation]:
    """What each critic says of new batches."""
    seen = {
        name: GPValueEstimator(critic, new.policy, discount).evaluate(new.data)
        for name, critic in critics.gaussian.items()
    }
    nothing = torch.zeros_like(new.true_return)
    seen["none"] = dataclasses.replace(seen["returns"], taken=nothing, value=nothing, next_value=nothing)
    seen["neural"] = GPValueEstimator(critics.neural, new.policy, discount).evaluate(new.data)
    return seen


def gradients(
    arm: Arm, new: Batches, several: Batches | None, critics: Critics, seen: dict[str, Evaluation]
) -> Float[Tensor, "L P"]:
    """The arm's gradient estimate from each batch: ascent direction, mean over steps."""
    weight = ESTIMATORS[arm.estimator](
        dataclasses.replace(seen[arm.critic], horizon=arm.horizon, trace=arm.trace)
    )
    critic = critics.gaussian[arm.critic] if arm.estimator in USE_ALL_ACTIONS else None
    if not arm.remembered or several is None:
        return ascent(new.data, new.policy, weight, critic)
    both = TensorDict.cat([first(several, REPLAYED[arm.critic]).data, new.data], 1)
    assert isinstance(both, TensorDict)
    return ascent(both, new.policy, weight.new_zeros(both.shape), critic)


def ascent(
    data: TensorDict, policy: GaussianPolicy, weight: Tensor, critic: GPActionValue | None = None
) -> Float[Tensor, "L P"]:
    """Gradient of each learner's batch for weights of the scores, with the all-action term of `critic`."""
    policy.zero_grad()
    data = data.clone(False).set("advantage", weight.unsqueeze(-1))
    PolicyGradientLoss(policy)(data)["loss_objective"].backward()
    if critic is not None:
        AllActionLoss(policy, critic)(data)["loss_all_action"].backward()
    parts = [p.grad.flatten(1) for p in policy.parameters() if p.grad is not None]
    return -torch.cat(parts, 1).double()


class Quality(NamedTuple):
    """Figures of one estimator: its value and the ends of a 95 % bootstrap interval, three numbers each."""

    nsr: Tensor
    cos_mean: Tensor
    cos_batch: Tensor
    relative_mse: Tensor


RESAMPLES = 2000


def quality(estimates: Float[Tensor, "N P"], reference: Float[Tensor, " P"]) -> Quality:
    """Noise, bias and both of an estimator, against a reference gradient.

    nsr = tr Cov / ‖mean‖²; cosine of the mean with the reference; mean cosine of a single batch; mean squared
    error over ‖reference‖².
    """
    count = len(estimates)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.multinomial(torch.ones(count), RESAMPLES * count, True, generator=generator)
    resampled = torch.zeros(RESAMPLES, count, dtype=torch.float64)
    resampled.scatter_add_(
        1, drawn.reshape(RESAMPLES, count), torch.ones(RESAMPLES, count, dtype=torch.float64)
    )
    share = torch.cat([torch.ones(1, count, dtype=torch.float64), resampled]) / count
    mean = share @ estimates
    square, along = estimates.square().sum(1), estimates @ reference
    length = reference.norm()
    mean_square = mean.square().sum(1)
    unbiased = count / (count - 1)
    figures = (
        unbiased * (share @ square - mean_square) / mean_square,
        mean @ reference / mean_square.sqrt() / length,
        share @ (along / square.sqrt() / length),
        share @ (estimates - reference).square().sum(1) / length.square(),
    )
    tail = torch.tensor([0.025, 0.975], dtype=torch.float64)
    return Quality(*(torch.cat([figure[:1], figure[1:].quantile(tail)]) for figure in figures))
