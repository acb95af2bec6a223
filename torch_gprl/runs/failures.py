"""What breaks while a run learns: told in one line, with the way to go on."""

import contextlib
import traceback
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from torch_gprl.runs.errors import UserError
from torch_gprl.runs.folder import RunFolder


class RunFailure(Exception):
    """Something broke while a run was learning.

    The message is one line: the cause, and how to go on from what was kept.
    """


@runtime_checkable
class Counted(Protocol):
    """Something that learns by updates."""

    updates: int


@contextlib.contextmanager
def failures_of(learner: Counted, folder: RunFolder) -> Iterator[None]:
    """Within it whatever breaks becomes a `RunFailure`, and its trace goes into the run's folder.

    If nothing does, the trace of an earlier failure is taken away.
    """
    try:
        yield
        folder.failure.unlink(missing_ok=True)
    except UserError:
        raise
    except Exception as error:
        with contextlib.suppress(OSError):  # the disk may be what failed
            folder.failure.write_text(traceback.format_exc(), encoding="utf-8")
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise RunFailure(
            f"failed after update {learner.updates} by {cause} (the trace is in {folder.failure}); "
            f"--resume {folder.path} goes on from the last checkpoint"
        ) from error
