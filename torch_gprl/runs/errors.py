"""Mistakes that are the user's to mend, shown as a single line without a traceback."""

import contextlib
from collections.abc import Iterator

import torch


class UserError(Exception):
    """Something outside the program is wrong: a path, a file, an option.

    The message is one line: the rule, what came, and a way out.
    """


@contextlib.contextmanager
def mistakes_of_the_user() -> Iterator[None]:
    """Within it bad values become a `UserError`: some options only the task or the algorithm can judge."""
    try:
        yield
    except (ValueError, KeyError, ModuleNotFoundError) as error:
        raise UserError(" ".join(str(error.args[0] if error.args else error).split())) from error


def check_device(name: str) -> None:
    """Refuse a device that is not there.

    Raises:
        UserError: with the reason.
    """
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device '{name}' cannot be used: {reason}; --device cpu always can") from error
