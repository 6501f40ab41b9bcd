"""faintspot study and loop: Monte-Carlo studies, and methods compared in a simulated closed loop."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError, require
from faintspot.base.files import derived, write_atomically
from faintspot.cli.commands import NAMES, NUMBERS, needs, option
from faintspot.cli.output import (
    CONFIGURATION,
    QUICK,
    experiment_options,
    progress_bar,
    simulate_night,
    worker_pool,
)

if TYPE_CHECKING:
    import xarray

    from faintspot.base.report.page import Report
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
        require("loop", "matplotlib", "jinja2", purpose="faintspot study estimators")
        from faintspot.experiments.report import study_report
        from faintspot.experiments.study.specification import estimators_study

        dataset = _measure(estimators_study(quick), target, **where)
        _write_page(study_report(dataset), derived(target, ".html"))
    else:
        from faintspot.experiments.study.specification import StudySpecification

        _measure(StudySpecification.from_file(specification), target, **where)
        click.echo(f"Next: faintspot report {shlex.quote(target)}")


def _repeat_the_paper(target: str, quick: bool, figures: tuple[str, ...], where: dict[str, Any]) -> None:
    """Run the paper's study and its observations, and write a page and a table."""
    require("loop", "matplotlib", "jinja2", "hcipy", purpose="faintspot study paper")
    from faintspot.experiments.night.page import PAGE_FILE
    from faintspot.experiments.paper.claims import paper_markdown, paper_rows
    from faintspot.experiments.report import night_folder, study_report
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
        _write_page(study_report(dataset, night), derived(target, ".html"))
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
    _write_page(loop_map_page(cells), folder / "report.html")


def _write_page(page: Report, path: Path) -> None:
    """Write a page, and say where it is."""
    page.write(path)
    click.echo(f"{shlex.quote(str(path))}: open it in a browser")


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


Names = tuple[str, ...]

_needs_loop = needs("loop", "hcipy", "joblib", "zarr", "matplotlib", "jinja2")
_output = option(
    "--output", "-o", metavar="FOLDER", help="Where results go.", show_default="CONFIG, CONFIG-quick ..."
)


def _compared(loop_group: Callable[..., object]) -> Callable[..., object]:
    """Add the options of every comparison."""
    return CONFIGURATION(QUICK(_output(experiment_options(loop_group))))


@click.group("loop")
def loop_group() -> None:
    """Compare methods in a simulated closed loop, and recommend one.

    Telescope, turbulence, Shack-Hartmann sensor, camera, mirror and control are simulated; slopes come from
    the same pipeline as everywhere. CONFIG is a TOML file or the name of a shipped configuration. Needs the
    extra `loop`. An interrupted command continues where it stopped.

    \b
    Examples:
      faintspot loop magnitude diffraction_limit
      faintspot loop magnitude camera_3e --methods brightest,smoothed,tv
      faintspot loop show canary > mine.toml
    """


@loop_group.command()
@click.argument("name", metavar="[CONFIG]", required=False)
def show(name: str | None) -> None:
    """Print a configuration as TOML with every value written out, or list the shipped ones."""
    from faintspot.loop.simulation.configuration import load_loop, shipped_loops

    if name is not None:
        click.echo(load_loop(name).to_text(), nl=False)
        return
    for name in shipped_loops():
        loop = load_loop(name)
        camera, sensor = loop.camera, loop.sensor
        noise = camera.read_noise_e / camera.em_gain
        click.echo(
            f"{name:18s} {loop.telescope.diameter_m:g} m, {sensor.subapertures}x{sensor.subapertures} "
            f"sub-apertures of {sensor.pixels}x{sensor.pixels} pixels, {noise:g} e- read noise, "
            f"{loop.photons:g} photons"
        )


@_needs_loop
@loop_group.command(short_help="Measure the Strehl ratio against the star's magnitude.")
@_compared
@option(
    "--methods",
    type=NAMES,
    metavar="NAMES",
    help="Methods to compare, with commas.",
    show_default="all that suit",
)
@option(
    "--flux-e",
    type=NUMBERS,
    metavar="NUMBERS",
    help="Fluxes with commas, photo-electrons per sub-aperture and frame.",
    show_default="four times to an eighth of the configuration's",
)
@option(
    "--write-config",
    metavar="TOML",
    help="Write what is recommended for the configuration's star, and the loop with its gain beside it.",
)
def magnitude(
    configuration: str,
    methods: Names | None,
    flux_e: tuple[float, ...] | None,
    write_config: str | None,
    output: str | None,
    quick: bool,
    overwrite: bool,
    **processes: Any,
) -> None:
    """Measure the Strehl ratio of any list of methods against the star's magnitude.

    Each method is tuned at each flux, its settings and the loop gain together, on other turbulence; one is
    recommended for each flux: the simplest of those not below the best beyond the error. Methods:
    every estimator by its name (`faintspot estimators` lists them); after the name may follow
    +predicted (its prior is what the loop predicts), +weighted (slopes count by their standard errors),
    +uncorrected (slopes are not divided by the centroid gain), and then the control: +kalman in place of the
    integrator.

    \b
    Examples:
      faintspot loop magnitude --quick
      faintspot loop magnitude diffraction_limit --methods map+predicted,map+kalman --flux-e 20
      faintspot loop magnitude camera_3e --methods brightest,smoothed,tv,ml --flux-e 60,200,640
    """
    from faintspot.experiments.closed_loop.magnitude import run_magnitude, save_recommended
    from faintspot.experiments.closed_loop.verdict import loop_page, loop_summary
    from faintspot.loop.simulation.configuration import load_loop

    loop = load_loop(configuration)
    folder, methods = output or (f"{loop.name}-quick" if quick else loop.name), _methods(methods)
    with worker_pool("loop", **processes) as pool:
        result = run_magnitude(loop, folder, methods, flux_e, quick=quick, pool=pool, overwrite=overwrite)
    click.echo(loop_summary(result))
    _write_page(loop_page(result), Path(folder) / "report.html")
    if write_config is not None:
        beside = save_recommended(result, loop, write_config)
        click.echo(f"{write_config}: written, and {beside}, the loop with this star and gain")


@_needs_loop
@loop_group.command(short_help="Alternate with and without TV, as on the telescope.")
@_compared
@option(
    "--methods",
    type=NAMES,
    metavar="NAMES",
    default="none,tv",
    help="Methods of a cycle, with commas; the first is the reference. none: brightest pixels; tv: every "
    "strength; others as for `loop magnitude`, with the integrator.",
)
@option(
    "--strengths",
    type=NUMBERS,
    metavar="NUMBERS",
    help="Strengths of TV in --unit, with commas.",
    show_default="8 or 20 from 0 to 2",
)
@option(
    "--unit",
    type=click.Choice(["e-", "counts"]),
    default="e-",
    help="Unit of strengths, which the paper does not state: photo-electrons, or counts of the camera.",
)
def night(
    configuration: str,
    methods: Names,
    strengths: tuple[float, ...],
    unit: str,
    output: str | None,
    quick: bool,
    **options: Any,
) -> None:
    """Alternate with and without TV in a simulated loop, as on the telescope.

    The protocol of the observations of Basden et al. 2015: four sets of cycles, each a block without TV, then
    8 or 20 strengths that rise from 0 to 2; the multiplication gain is full in the first two sets and at 75 %
    in the last two; one atmosphere, whose r0 drifts. Of its hour a sixth is simulated. The page compares
    Strehl ratios against time, r0 and strength, judges the paper's statements with their significance,
    compares its Table 1, and states how many hours of observing would show each difference. A run without TV
    in the same turbulence tells the true difference. An interrupted command continues with the missing sets.

    \b
    Examples:
      faintspot loop night
      faintspot loop night canary --unit counts
      faintspot loop night emccd --methods none,tv,smoothed,window --strengths 0.4,0.8
    """
    from faintspot.experiments.night.page import PAGE_FILE, night_summary_text
    from faintspot.experiments.night.protocol import QUICK_PLAN, NightPlan
    from faintspot.loop.simulation.configuration import load_loop

    plan = QUICK_PLAN if quick else NightPlan()
    plan = replace(plan, methods=methods, listed_strengths=strengths or (), unit=unit)
    loop = load_loop(configuration)
    kind = ("-counts" if unit == "counts" else "") + ("-quick" if quick else "")
    folder = Path(output or f"{loop.name}-night{kind}")
    click.echo(night_summary_text(simulate_night(loop, folder, plan=plan, quick=quick, **options)))
    click.echo(f"{shlex.quote(str(folder / PAGE_FILE))}: open it in a browser")


@needs("loop", "hcipy")
@loop_group.command(short_help="Write what a real-time engine needs, [control] included.")
@CONFIGURATION
@option("--output", "-o", default=".", metavar="FOLDER", help="Folder for faintspot.toml and matrices.")
@option(
    "--control",
    metavar="KIND",
    default="integrator",
    help="Control: integrator, or kalman, which learns from the loop for up to a minute.",
)
@option("--frame-rate-hz", type=float, metavar="HZ", help="Frame rate.", show_default="CONFIG")
def engine(configuration: str, output: str, control: str, frame_rate_hz: float | None) -> None:
    """Write faintspot.toml with which `faintspot realtime run --close-loop` closes this loop.

    Layout, calibration, PSF and [control] with interaction matrix, reference slopes and centroid gain, from
    the simulation. Estimator, settings and whatever else faintspot.toml says already stay, such as what
    `faintspot loop magnitude` recommends; without an estimator it gets the 20 brightest pixels.

    \b
    Examples:
      faintspot loop engine canary -o bench
      faintspot loop engine faintspot-loop.toml --control kalman
    """
    from faintspot.loop.simulation.configuration import load_loop
    from faintspot.loop.simulation.engine_files import write_engine_files

    loop = load_loop(configuration)
    if frame_rate_hz is not None:
        loop = loop.replace("control", frame_rate_hz=frame_rate_hz)
    path = write_engine_files(loop, output, control)
    click.echo(f"{path} written; next: faintspot realtime run --config {shlex.quote(str(path))} --close-loop")


def _methods(names: Names | None) -> Names | None:
    """Return the methods that are asked for; name those that could use the loop's prediction but do not."""
    from faintspot.loop.simulation.methods import Method

    for name in names or ():
        method = Method.named(name)
        if method.estimator.takes_prior and not method.is_predicted:
            own, plus, rest = method.name.partition("+")
            click.echo(
                f"{name}: without the loop's prediction; {own}+predicted{plus}{rest} uses it", err=True
            )
    return names
