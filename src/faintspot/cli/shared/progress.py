"""The progress bar of long commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from faintspot.base.extras import present

_SPEED_OVER_S = 120.0  # work of several kinds is done in turns


class _Rate(ProgressColumn):
    """Units per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self.unit = unit

    def render(self, task: Task) -> Text:
        """Return the rate as text."""
        return Text(
            f"{task.completed / task.elapsed:,.0f} {self.unit}/s" if task.elapsed else f"- {self.unit}/s"
        )


@contextmanager
def progress_bar(what: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """Show a bar on standard error; yields a function to call with finished and total counts.

    A bar that never moved leaves no trace, so that an error before the first frame stands alone. Where
    standard error is not a terminal, the bar is printed once, at its end; so it is in a notebook without
    ipywidgets, with which the bar moves.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    if console.is_jupyter and not present("ipywidgets"):
        console = Console(stderr=True, force_jupyter=False)
    progress = Progress(*columns, console=console, transient=True, speed_estimate_period=_SPEED_OVER_S)
    task = progress.add_task(what, total=None)

    def advance(finished: int, total: int) -> None:
        progress.live.transient = False
        progress.start()
        progress.update(task, completed=finished, total=total)

    try:
        if console.is_interactive:
            progress.start()
        yield advance
    finally:
        if progress.live.is_started:
            progress.refresh()  # a notebook's bar would stay where it was when last drawn
            progress.stop()
