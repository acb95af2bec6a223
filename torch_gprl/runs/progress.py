"""How a run is going: a live panel on a terminal, a plain line now and then in a file or a log."""

import time
from collections.abc import Callable, Mapping
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from torch import Tensor

PLAIN_INTERVAL = 5.0  # s between lines where there is no terminal
SHOWN = {"return": "return", "sigma": "σ", "basis_size": "basis"}  # metric -> label


class PatientConsole(Console):
    """A console that nobody has to read to the end, as behind `2>&1 | head`; rich's own would end the run."""

    def on_broken_pipe(self) -> None:
        """Fall silent."""
        self.quiet = True


class Progress:
    """Shows the state of a run; use as a context manager.

    Args:
        total_frames: environment steps per learner that the run will take.
        title: what is running.
        console: where to show it; standard error by default, so that results alone reach standard output.
        clock: seconds, monotonic.
        before: environment steps per learner that were taken earlier, if the run is resumed.
    """

    def __init__(
        self,
        total_frames: int,
        title: str,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
        before: int = 0,
    ) -> None:
        self._total_frames, self._before = total_frames, before
        self._title = title
        self._console = console or PatientConsole(stderr=True)
        self._clock = clock
        self._live = Live(console=self._console, auto_refresh=False)
        self._start = self._last_line = clock()

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def update(self, frames: int, metrics: Mapping[str, Tensor]) -> None:
        """Show an update.

        Args:
            frames: environment steps per learner so far.
            metrics: name -> values `[learners]`; `return` is among them.
        """
        now, learners = self._clock(), len(metrics["return"])
        speed = (frames - self._before) / max(now - self._start, 1e-9)  # steps per second and learner
        facts = {label: _mean_and_spread(metrics[name]) for name, label in SHOWN.items() if name in metrics}
        facts["steps/s"] = f"{speed * learners:,.0f}"
        facts["left"] = _duration((self._total_frames - frames) / speed)
        if self._console.is_terminal:
            self._live.update(self._panel(frames, facts), refresh=True)
        elif now - self._last_line >= PLAIN_INTERVAL or frames >= self._total_frames:
            self._last_line = now
            told = "  ".join(f"{label} {fact}" for label, fact in facts.items())
            line = f"{frames / self._total_frames:4.0%}  steps {frames:,}/{self._total_frames:,}  {told}"
            self._console.print(line, soft_wrap=True, highlight=False, markup=False)

    def _panel(self, frames: int, facts: Mapping[str, str]) -> Panel:
        table = Table.grid(expand=True)
        for _ in facts:
            table.add_column(justify="center")
        table.add_row(*(f"[dim]{label}[/dim]" for label in facts))
        table.add_row(*(f"[bold]{fact}[/bold]" for fact in facts.values()))
        bar = ProgressBar(total=self._total_frames, completed=frames)
        below = f"{frames:,} of {self._total_frames:,} environment steps per learner"
        return Panel(Group(table, bar), title=self._title, subtitle=below)


def _mean_and_spread(values: Tensor) -> str:
    """Mean over the learners that have a value, and the standard deviation between them."""
    values = values[values.isfinite()].double()
    if not len(values):
        return "–"  # no episode has ended yet
    mean = f"{values.mean().item():.4g}"
    return f"{mean} ± {values.std().item():.2g}" if len(values) > 1 else mean


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(max(int(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
