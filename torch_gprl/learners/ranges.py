"""Which numbers a configuration allows, said in the same words for every learner."""

import math
from collections.abc import Collection, Mapping
from typing import Any, get_args

INF = math.inf


def check_ranges(
    numbers: object,
    least: Mapping[str, float] | None = None,
    positive: Collection[str] = (),
    shares: Collection[str] = (),
    discounts: Collection[str] = (),
) -> None:
    """Refuse fields of a configuration that are out of their ranges.

    Args:
        numbers: a dataclass.
        least: field -> the least finite number that it may be.
        positive: fields above 0, and finite.
        shares: fields from 0 to 1.
        discounts: fields from 0 to 1, 1 excluded.

    Raises:
        ValueError: naming the field, its value and what would be valid.
    """
    for name, bound in (least or {}).items():
        _refuse_unless(bound <= getattr(numbers, name) < INF, numbers, name, f"be at least {bound}")
    for name in positive:
        _refuse_unless(0 < getattr(numbers, name) < INF, numbers, name, "be positive")
    for name in shares:
        _refuse_unless(0 <= getattr(numbers, name) <= 1, numbers, name, "lie between 0 and 1")
    for name in discounts:
        _refuse_unless(0 <= getattr(numbers, name) < 1, numbers, name, "be at least 0 and below 1")


def check_choices(numbers: object, choices: Mapping[str, Any]) -> None:
    """Refuse fields of a configuration that are none of their literals.

    Args:
        numbers: a dataclass.
        choices: field -> its `Literal`.

    Raises:
        ValueError: naming the field, its value and what would be valid.
    """
    for name, kind in choices.items():
        if getattr(numbers, name) not in get_args(kind):
            known = ", ".join(get_args(kind))
            raise ValueError(f"{name} must be one of {known}, got {getattr(numbers, name)!r}")


def _refuse_unless(holds: bool, numbers: object, name: str, rule: str) -> None:
    if not holds:
        raise ValueError(f"{name} must {rule}, got {getattr(numbers, name)}")
