"""Stopping a run gently: Ctrl-C asks, a second Ctrl-C insists."""

import os
import signal
from types import FrameType

STDERR = 2  # file descriptor


class StopRequest:
    """Within it the first Ctrl-C (or SIGTERM) only sets `asked`; the second Ctrl-C interrupts as usual."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "StopRequest":
        self._before = {kind: signal.signal(kind, self._ask) for kind in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)

    def _ask(self, kind: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # print may be what was interrupted, and does not bear a second call inside the first.
        os.write(STDERR, b"\nfinishing this update; Ctrl-C again aborts\n")
