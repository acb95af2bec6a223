"""The display: a panel on a terminal, a line every few seconds elsewhere."""

import contextlib
import io
import os
import sys

import pytest
import torch
from rich.console import Console

from torch_gprl.runs import Progress


class Clock:
    """A clock that the test moves."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


UPDATE = {
    "return": torch.tensor([10.0, 14.0]),
    "sigma": torch.tensor([0.5, 0.5]),
    "basis_size": torch.tensor([100, 100]),
}


def shown(terminal: bool, times: list[float], update: dict[str, torch.Tensor] = UPDATE) -> str:
    """What is shown after updates of 100 steps each at these seconds."""
    clock = Clock()
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100, color_system=None)
    with Progress(1000, "pendulum", console=console, clock=clock) as progress:
        for number, seconds in enumerate(times, start=1):
            clock.now = 1000.0 + seconds
            progress.update(100 * number, update)
    return console.file.getvalue()


def test_a_line_tells_return_exploration_basis_speed_and_time_left():
    assert shown(False, [10.0]).split("  ") == [
        " 10%",
        "steps 100/1,000",
        "return 12 ± 2.8",
        "σ 0.5 ± 0",
        "basis 100 ± 0",
        "steps/s 20",
        "left 1:30\n",
    ]


def test_lines_come_every_few_seconds_and_at_the_end():
    lines = shown(False, [1.0, 2.0, 6.0, 7.0, 8.0, 9.0, 9.1, 9.2, 9.3, 9.4]).splitlines()
    assert [line.split()[0] for line in lines] == ["30%", "100%"]


def test_a_terminal_shows_the_panel():
    panel = shown(True, [10.0])
    for text in ("pendulum", "return", "12 ± 2.8", "σ", "basis", "1:30", "100 of 1,000 environment steps"):
        assert text in panel


def test_a_run_without_exploration_or_basis_is_shown_too():
    console = Console(file=io.StringIO(), force_terminal=False, width=100)
    with Progress(100, "baseline", console=console, clock=Clock()) as progress:
        progress.update(100, {"return": torch.tensor([3.0])})
    assert "return 3  steps/s" in console.file.getvalue()


def test_an_error_inside_passes_through():
    with pytest.raises(KeyboardInterrupt), Progress(1, "", console=Console(file=io.StringIO())):
        raise KeyboardInterrupt


def test_there_is_no_return_before_an_episode_has_ended():
    none, some = torch.tensor([torch.nan, torch.nan]), torch.tensor([torch.nan, 7.0])
    assert "return –  " in shown(False, [10.0], UPDATE | {"return": none})
    assert "return 7  " in shown(False, [10.0], UPDATE | {"return": some})


def test_a_display_that_nobody_looks_at_ends_nothing(monkeypatch):
    reading, writing = os.pipe()
    os.close(reading)
    closed = os.fdopen(writing, "w")
    monkeypatch.setattr(sys, "stderr", closed)
    with Progress(100, "pendulum") as progress:
        progress.update(100, UPDATE)
        progress.update(100, UPDATE)
    with contextlib.suppress(BrokenPipeError):
        closed.close()
