"""Looking ahead: the best of some courses of actions, tried on the model from the state that one is in.

The best action of a plan errs as the values between support states do. Over some imagined steps these errors
weigh little: rewards are summed as they come, and the planned value counts for what is left at the end,

    J(a_0 … a_{H−1}) = Σ_{t<H} γᵗ r̂(s_t, a_t) + γᴴ V(s_H).

A walk goes on as likely as the model sees no end. The best course is begun, and looked at again in the next
state: compared are the rest of it, variations of that at all scales, and the course of the policy that is at
hand, so that in imagination nothing worse is performed. (Model predictive control by random shooting; Lowrey,
Rajeswaran, Kakade, Todorov and Mordatch, 2019, put a learned value at the end.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

WIDEST, FINEST = 0.8, 0.008  # standard deviations of variations, in halves of the actuator's range
LIKENESS = 0.8  # correlation of a variation with itself a step later: what moves a robot lasts
SEED = 0  # of the variations, which are the same in every state: what is performed has no chance in it


@dataclass(frozen=True)
class LookAhead:
    """Looks for courses of actions that earn much.

    Args:
        step: states [L, N, S] and actions [L, N, A] to what follows [L, N, S], rewards, and chances of an end
            [L, N].
        value: states to what is earned from there on [L, N].
        policy: states to the actions of the policy at hand [L, N, A].
        discount: γ per step.
        steps: H, of a course.
    """

    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
    value: Callable[[Tensor], Tensor]
    policy: Callable[[Tensor], Tensor]
    discount: float
    steps: int

    def course(
        self,
        states: Float[Tensor, "L N S"],
        last: Float[Tensor, "L N H A"] | None,
        variations: Float[Tensor, "K H A"],
        chunk: int,
    ) -> Float[Tensor, "L N H A"]:
        """The best found in each state.

        Args:
            states: where courses begin.
            last: what to go on with; the policy's course if None.
            variations: of it, to be compared.
            chunk: states of each learner at a time; bounds the memory.
        """
        courses = []
        for first in range(0, states.shape[1], chunk):
            some = states[:, first : first + chunk]
            begun = self.followed(some) if last is None else last[:, first : first + chunk]
            courses.append(self.better(some, begun, variations))
        return torch.cat(courses, 1)

    def followed(self, states: Float[Tensor, "L N S"]) -> Float[Tensor, "L N H A"]:
        """The course of the policy."""
        course: list[Tensor] = []
        for _ in range(self.steps):
            course.append(self.policy(states))
            states = self.step(states, course[-1])[0]
        return torch.stack(course, 2)

    def earned(
        self, states: Float[Tensor, "L N S"], courses: Float[Tensor, "L N K H A"]
    ) -> Float[Tensor, "L N K"]:
        """J of courses, in units of the return."""
        many, count = courses.shape[1:3], courses.shape[2]
        states = states.repeat_interleave(count, 1)
        lasting = torch.ones_like(states[..., 0])
        total = torch.zeros_like(lasting)
        for actions in courses.flatten(1, 2).unbind(-2):
            states, reward, end = self.step(states, actions)
            total = total + lasting * reward
            lasting = self.discount * lasting * (1 - end)
        return (total + lasting * self.value(states)).unflatten(1, many)

    def better(
        self, states: Float[Tensor, "L N S"], course: Float[Tensor, "L N H A"], variations: Tensor
    ) -> Float[Tensor, "L N H A"]:
        """The best of a course, its variations [K, H, A], and the policy's course."""
        varied = (course.unsqueeze(2) + variations.to(course)).clamp(-1, 1)
        known = torch.stack([self.followed(states), course], 2)
        courses = torch.cat([known, varied], 2)  # of courses that earn alike the first is taken
        best = self.earned(states, courses).argmax(-1)
        return courses.take_along_dim(best[..., None, None, None], 2).squeeze(2)


@cache
def variations(each: int, steps: int, columns: int) -> Float[Tensor, "K H A"]:
    """Smooth deviations from a course, in pairs of both signs, from the widest to the finest.

    Args:
        each: K/A, how many for each column of the action; K is rounded down to an even number.
        steps: H.
        columns: A.
    """
    pairs = each * columns // 2
    draws = torch.randn(
        pairs, steps, columns, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64
    )
    smooth = [draws[:, 0]]
    for draw in draws[:, 1:].unbind(1):
        smooth.append(LIKENESS * smooth[-1] + (1 - LIKENESS**2) ** 0.5 * draw)
    scales = WIDEST * (FINEST / WIDEST) ** torch.linspace(0, 1, pairs, dtype=torch.float64)
    deviations = torch.stack(smooth, 1) * scales[:, None, None]
    return torch.cat([deviations, -deviations])


def continued(course: Float[Tensor, "L N H A"]) -> Float[Tensor, "L N H A"]:
    """The rest of a course whose first action is over: its last action is repeated."""
    return torch.cat([course[:, :, 1:], course[:, :, -1:]], 2)
