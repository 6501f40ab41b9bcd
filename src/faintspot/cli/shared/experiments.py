"""Experiments in several processes: their options, their progress, and the simulated observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.cli.shared.commands import option
from faintspot.cli.shared.progress import progress_bar

if TYPE_CHECKING:
    from faintspot.experiments.night.blocks import Night
    from faintspot.experiments.running import WorkerPool
    from faintspot.loop.simulation.configuration.configuration import LoopConfiguration

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
