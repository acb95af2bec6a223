"""What a run says on standard output; it ends nothing that nobody listens any more, as behind `| head`."""

import contextlib
import os
import sys
from collections.abc import Iterator


def tell(line: object) -> None:
    """Print a line at once, or nothing if nobody reads."""
    with unread_output_allowed():
        print(line, flush=True)


@contextlib.contextmanager
def unread_output_allowed() -> Iterator[None]:
    """Within it a standard output that was closed ends what is going on, without an error."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
