"""faintspot study: Monte-Carlo studies of the slope error."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError, require
from faintspot.base.files import derived, write_atomically
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.progress import QUICK, experiment_options, progress_bar, simulate_night, worker_pool

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from faintspot.experiments.night.protocol import Night
    from faintspot.experiments.study.specification import StudySpecification

_PAPER, _ESTIMATORS = "paper", "estimators"
_LOOP = "loop"  # a figure that the paper has not, and takes longer than all others


@needs("loop", "joblib", "xarray", "zarr")
@click.command()
@click.argument("specification", metavar="STUDY")
@QUICK
@option(
    "--figure",
    "figures",
    multiple=True,
    metavar="NAME",
    help="Only what this figure of the paper needs: fig2 to fig7, or night (Table 1 and its figure). loop: "
    "where denoising pays in a closed loop.",
)
@option(
    "--output",
    "-o",
    metavar="ZARR",
    help="Where results go.",
    show_default="STUDY.zarr, STUDY-quick.zarr ...",
)
@experiment_options
def command(
    specification: str, quick: bool, figures: tuple[str, ...], output: str | None, **where: Any
) -> None:
    """Measure the slope error by Monte-Carlo simulation.

    Spots at random known positions, photon and read noise; the error of the centre of gravity with and
    without denoising, and of other methods, on the same images; the settings of each chosen on one half of
    the images and scored on the other. Each finished cell of the sweep is stored; interrupted or killed and
    started again, the command goes on where it stopped.

    \b
    STUDY is one of
    paper       Basden et al. 2015 (arXiv:1503.06043): every figure and table and a verdict on every claim,
                with error bars, in a report page and a Markdown table beside the store of results; the
                Monte-Carlo figures, then the observations, as `faintspot loop night` simulates them
    estimators  all estimators and the Cramer-Rao bound: photon efficiency, gain and outliers over signal and
                read noise, for round and elongated spots, and the error on spots that turbulence has
                speckled, in a report page beside the store
    FILE.toml   a study of your own: what is varied (flux, read noise, spot size and shape, elongation,
                sub-aperture size, range of positions, background, EM gain, turbulence), which methods are
                compared and what they may choose from; docs/study.md has examples

    The store opens with faintspot.experiments.open_study or xarray.open_zarr.

    \b
    Examples:
      faintspot study my-study.toml -o my-study.zarr
      faintspot study paper --quick
      faintspot study paper --figure fig4 --figure night
      faintspot study estimators --quick
    """
    is_file = specification not in (_PAPER, _ESTIMATORS)
    if is_file and quick:
        raise InputError(f"--quick: expected {_PAPER} or {_ESTIMATORS}, got {specification}")
    if figures and specification != _PAPER:
        raise InputError(f"--figure: expected {_PAPER}, got {specification}")
    target = (
        output
        or "-".join([str(derived(specification, "")), *(["quick"] if quick else []), *figures]) + ".zarr"
    )
    if specification == _PAPER:
        _repeat_the_paper(target, quick, figures, where)
    elif specification == _ESTIMATORS:
        from faintspot.experiments.study.specification import estimators_study

        require("loop", "matplotlib", "jinja2", purpose="faintspot study estimators")
        _write_page(_measure(estimators_study(quick), target, **where), target)
    else:
        from faintspot.experiments.study.specification import StudySpecification

        _measure(StudySpecification.from_file(specification), target, **where)
        click.echo(f"Next: faintspot report {shlex.quote(target)}")


def _repeat_the_paper(target: str, quick: bool, figures: tuple[str, ...], where: dict[str, Any]) -> None:
    """Run the paper's study and its observations, and write a page and a table."""
    require("loop", "matplotlib", "jinja2", "hcipy", purpose="faintspot study paper")
    from faintspot.experiments.night.page import PAGE_FILE
    from faintspot.experiments.paper.claims import paper_markdown, paper_rows
    from faintspot.experiments.report import night_folder
    from faintspot.experiments.study.specification import FIGURES, NIGHT, paper_study
    from faintspot.loop.simulation.configuration import load_loop

    of_study = tuple(name for name in figures or FIGURES if name not in (NIGHT, _LOOP))
    described = paper_study(quick, of_study) if of_study else None
    dataset = None if described is None else _measure(described, target, **where)
    night = None
    if NIGHT in figures or not figures:
        folder = night_folder(target)
        night = simulate_night(load_loop("canary"), folder, quick=quick, **where)
        click.echo(f"{folder / PAGE_FILE}: open it in a browser")
    if _LOOP in figures:
        _map_the_loop(derived(target, "-map"), quick, **where)
    if dataset is not None:
        _write_page(dataset, target, night)
    if dataset is None and night is None:
        return
    table = derived(target, ".md")
    write_atomically(table, paper_markdown(paper_rows(dataset, night)))
    click.echo(f"{table}: the paper, figure by figure")


def _map_the_loop(
    folder: Path, quick: bool, overwrite: bool, workers: int | None, scheduler: str | None
) -> None:
    """Compare methods in closed loops, and write their page."""
    from faintspot.experiments.paper.loop_map import loop_map_page, run_loop_map

    with worker_pool("loop", workers, scheduler) as pool:
        cells = run_loop_map(folder, quick=quick, pool=pool, overwrite=overwrite)
    page = folder / "report.html"
    loop_map_page(cells).write(page)
    click.echo(f"{page}: open it in a browser")


def _write_page(dataset: xarray.Dataset, target: str, night: Night | None = None) -> None:
    """Write the page of a study beside its store."""
    from faintspot.experiments.report import study_report

    page = derived(target, ".html")
    study_report(dataset, night).write(page)
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
