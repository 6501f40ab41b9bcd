"""faintspot study: Monte-Carlo studies of the slope error."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.files import derived, write_atomically
from faintspot.cli.shared.commands import Group, option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import SCHEDULER, WORKERS
from faintspot.cli.shared.progress import progress_bar

if TYPE_CHECKING:
    import xarray

    from faintspot.experiments.night.blocks import Night
    from faintspot.experiments.study.specification import StudySpecification


def _run_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that say where and how a study runs."""
    for each in (
        option("--overwrite", is_flag=True, help="Replace the store of another study."),
        SCHEDULER,
        WORKERS,
    ):
        command = each(command)
    return command


@click.group(cls=Group, name="study", short_help="Measure how large the slope error is.")
def command() -> None:
    """Measure how large the slope error is, by Monte-Carlo simulation.

    Spots at random known positions, photon and read noise; the error of the centre of gravity with and
    without denoising, and of other methods, on the same images; the settings of each chosen on one half of
    the images and scored on the other.

    \b
    Examples:
      faintspot study run my-study.toml -o my-study.zarr
      faintspot study paper --quick
      faintspot study estimators --quick
    """


@needs("loop", "joblib", "xarray", "zarr")
@command.command(short_help="Run a study of your own.")
@click.argument("specification", metavar="TOML")
@option(
    "--output", "-o", metavar="ZARR", help="Where results go.", show_default="the TOML file's name with .zarr"
)
@_run_options
def run(specification: str, output: str | None, **where: Any) -> None:
    """Run a study of your own.

    TOML lists what is varied (flux, read noise, spot size and shape, elongation, sub-aperture size, range of
    positions, background, EM gain, turbulence), which methods are compared and what they may choose from;
    docs/study.md has examples. Each finished cell of the sweep is stored; interrupted or killed and started
    again, the command goes on where it stopped. The store opens with faintspot.experiments.open_study or
    xarray.open_zarr.

    \b
    Example:
      faintspot study run my-study.toml -o my-study.zarr
    """
    from faintspot.experiments.study.specification import StudySpecification

    described = StudySpecification.from_file(specification)
    target = output or str(derived(specification, ".zarr"))
    _measure(described, target, **where)
    click.echo(f"Next: faintspot report {shlex.quote(target)}")


@needs("loop", "joblib", "xarray", "zarr", "matplotlib", "jinja2", "hcipy")
@command.command(short_help="Repeat the study of Basden et al. 2015.")
@option("--quick", is_flag=True, help="Fewer cells and realisations: about a minute.")
@option(
    "--figure",
    "figures",
    multiple=True,
    metavar="NAME",
    help="Only what this figure needs: fig2 to fig7, or night (Table 1 and its figure).",
)
@option(
    "--output",
    "-o",
    metavar="ZARR",
    help="Where results go; the report beside it.",
    show_default="paper.zarr, or paper-quick.zarr and the like",
)
@_run_options
def paper(quick: bool, figures: tuple[str, ...], output: str | None, **where: Any) -> None:
    """Repeat the study of Basden et al. 2015 (arXiv:1503.06043).

    Every figure and table of the paper and a verdict on every claim, with error bars, in one report page and
    one Markdown table beside the store of results: the Monte-Carlo figures, then the observations, as
    `faintspot loop night` simulates them. Interrupted or killed and started again, the command goes on where
    it stopped.

    \b
    Examples:
      faintspot study paper --quick
      faintspot study paper -o paper.zarr
      faintspot study paper --figure fig4 --figure night
    """
    from faintspot.experiments.paper.whole import paper_markdown, paper_rows
    from faintspot.experiments.report.page import night_folder, study_report
    from faintspot.experiments.study.built_in import FIGURES, NIGHT, paper_study

    target = output or "-".join(["paper", *(["quick"] if quick else []), *figures]) + ".zarr"
    of_study = tuple(name for name in figures or FIGURES if name != NIGHT)
    described = paper_study(quick, of_study) if of_study else None
    dataset = None if described is None else _measure(described, target, **where)
    night = _night(night_folder(target), quick, **where) if NIGHT in figures or not figures else None
    if dataset is not None:
        page = derived(target, ".html")
        study_report(dataset, night).write(page)
        click.echo(f"{page}: open it in a browser")
    table = derived(target, ".md")
    write_atomically(table, paper_markdown(paper_rows(dataset, night)))
    click.echo(f"{table}: the paper, figure by figure")


def _night(folder: Path, quick: bool, overwrite: bool, workers: int | None, scheduler: str | None) -> Night:
    """Simulate the paper's observations with a progress bar and write their page."""
    from faintspot.experiments.night.page import PAGE_FILE, write_night
    from faintspot.experiments.night.simulated import run_night
    from faintspot.experiments.running import WorkerPool
    from faintspot.loop.simulation.configuration.configuration import load_loop

    with progress_bar("night") as advance:
        pool = WorkerPool(workers, advance, lambda text: click.echo(text, err=True), scheduler)
        night = run_night(load_loop("canary"), folder, quick=quick, pool=pool, overwrite=overwrite)
    write_night(night, folder)
    click.echo(f"{folder / PAGE_FILE}: open it in a browser")
    return night


@needs("loop", "joblib", "xarray", "zarr", "matplotlib", "jinja2")
@command.command(short_help="Compare all estimators with each other and with the limit.")
@option("--quick", is_flag=True, help="A few cells of fewer realisations: less than a minute.")
@option(
    "--output",
    "-o",
    metavar="ZARR",
    help="Where results go; the report beside it.",
    show_default="estimators.zarr, or estimators-quick.zarr",
)
@_run_options
def estimators(quick: bool, output: str | None, **where: Any) -> None:
    """Compare all estimators with each other and with the Cramer-Rao bound.

    Photon efficiency, gain and outliers over signal and read noise, for round and elongated spots, and the
    error on spots that turbulence has speckled, in one report page beside the store of results.

    \b
    Examples:
      faintspot study estimators --quick
      faintspot study estimators -o estimators.zarr
    """
    from faintspot.experiments.study.built_in import estimators_study

    target = output or f"estimators{'-quick' if quick else ''}.zarr"
    _measure_and_report(estimators_study(quick), target, where)


def _measure_and_report(described: StudySpecification, target: str, where: dict[str, Any]) -> None:
    """Run a study and write its page beside the store."""
    from faintspot.experiments.report.page import study_report

    page = derived(target, ".html")
    study_report(_measure(described, target, **where)).write(page)
    click.echo(f"{page}: open it in a browser")


def _measure(
    described: StudySpecification, target: str, overwrite: bool, workers: int | None, scheduler: str | None
) -> xarray.Dataset:
    """Run a study with a progress bar."""
    from faintspot.experiments.running import WorkerPool
    from faintspot.experiments.study.run import run as run_study

    realisations, counts = described.realisations, list[int]()

    def advance_by_cells(finished: int, total: int) -> None:
        counts.append(finished)
        advance(finished * realisations, total * realisations)

    with progress_bar("study", "realisations") as advance:
        pool = WorkerPool(workers, advance_by_cells, lambda text: click.echo(text, err=True), scheduler)
        results = run_study(described, target, pool=pool, overwrite=overwrite)
    cells = f"{results.sizes['cell']} cells of {realisations} realisations"
    if counts:
        click.echo(f"{target}: {cells}, {counts[-1] - counts[0]} of them in this run")
    else:
        click.echo(f"{target}: complete already ({cells}); --overwrite makes it anew")
    return results
