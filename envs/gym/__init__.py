"""Gymnasium's continuous control tasks, batched, with the numbers that Gymnasium gives to the last bit."""

from envs.gym import arms, classic, legged, pendulums, whole_body
from envs.task import Task

TASKS: tuple[Task, ...] = (
    *legged.TASKS,
    *whole_body.TASKS,
    *arms.TASKS,
    *pendulums.TASKS,
    *classic.TASKS,
)
