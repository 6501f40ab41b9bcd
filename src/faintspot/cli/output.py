"""Tables, texts, pictures and progress that commands show; experiments in several processes."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
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
from rich.table import Table
from rich.text import Text

from faintspot.base.errors import InputError, present
from faintspot.base.files import derived, write_atomically
from faintspot.cli.commands import can_make, option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from faintspot.experiments.night.protocol import Night
    from faintspot.experiments.running import WorkerPool
    from faintspot.loop.simulation.configuration import LoopConfiguration


_WIDEST_TEXT = 110


def check_target(target: Path, overwrite: bool) -> None:
    """Refuse a file in a folder that is not there, and one that already exists."""
    if not target.absolute().parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist: create it or choose another")
    if target.exists() and not overwrite:
        raise InputError(f"{target}: already exists; --overwrite replaces its settings and keeps its layout")


def results_table(first: str, *headings: str, wraps: bool = False) -> Table:
    """Return an empty table whose columns hold numbers, but for the first one, which may wrap its texts."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, caption_justify="left")
    table.add_column(first, no_wrap=not wraps, ratio=1 if wraps else None)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def wrapped(lines: list[str], console: Console, indent: str = "") -> list[str]:
    """Return lines that fit the terminal."""
    width = min(console.width, _WIDEST_TEXT)
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            line, width, initial_indent=indent, subsequent_indent=f"{indent}  ", break_long_words=False
        )
    ]


def picture_file(target: Path, picture: str | None, ending: str) -> Path | None:
    """Return where the picture goes; None, said now, where it cannot be drawn and was not asked for."""
    if not can_make("picture", "matplotlib", asked=picture is not None):
        return None
    return Path(picture) if picture else derived(target, ending)


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    from faintspot.base.report.plots import png

    write_atomically(path, png(figure))
    click.echo(f"picture: {path}")


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


CONFIGURATION = click.argument("configuration", metavar="[CONFIG]", default="canary")
QUICK = option("--quick", is_flag=True, help="Fewer and shorter runs: a few minutes.")
_OPTIONS = (
    option("--overwrite", is_flag=True, help="Replace another experiment that is there."),
    option("--scheduler", metavar="ADDRESS", help="Dask scheduler to use instead: tls://host:8786."),
    option(
        "--workers",
        type=click.IntRange(0),
        help="Processes on this machine; 0 or 1: this process alone.",
        show_default="all processors",
    ),
)


def experiment_options(command: Callable[..., object]) -> Callable[..., object]:
    """Add the options that say where and how an experiment runs."""
    for each in _OPTIONS:
        command = each(command)
    return command


@contextmanager
def worker_pool(what: str, workers: int | None, scheduler: str | None) -> Iterator[WorkerPool]:
    """Yield the processes of an experiment, which show their progress."""
    from faintspot.experiments.running import WorkerPool

    with progress_bar(what) as advance:
        yield WorkerPool(workers, advance, lambda text: click.echo(text, err=True), scheduler)


def simulate_night(
    loop: LoopConfiguration, folder: Path, workers: int | None, scheduler: str | None, **options: Any
) -> Night:
    """Simulate alternating observations with a progress bar, and write their page."""
    from faintspot.experiments.night.page import write_night
    from faintspot.experiments.night.simulated import run_night

    with worker_pool("night", workers, scheduler) as pool:
        night = run_night(loop, folder, pool=pool, **options)
    write_night(night, folder)
    return night
