"""faintspot loop night: the paper's alternating observations, in a simulated loop."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import click

from faintspot.base.errors import InputError
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import SCHEDULER, WORKERS
from faintspot.cli.shared.progress import progress_bar


@needs("loop", "hcipy", "joblib", "zarr", "matplotlib", "jinja2")
@click.command("night", short_help="Alternate with and without TV, as on the telescope.")
@click.argument("configuration", metavar="[CONFIG]", default="canary")
@option(
    "--methods",
    metavar="NAMES",
    default="none,tv",
    help="Methods of a cycle, with commas; the first is the reference. none: brightest pixels; tv: every "
    "strength; others as for `loop magnitude`, with the integrator.",
)
@option(
    "--strengths",
    metavar="NUMBERS",
    help="Strengths of TV [e-], with commas.",
    show_default="8 or 20 from 0 to 2",
)
@option(
    "--strength-factors",
    metavar="FILE",
    help="Factor on the strength in each sub-aperture (.npy, .csv).",
    show_default="1",
)
@option(
    "--tuned",
    is_flag=True,
    help="Tune pixels kept, loop gain and options of each method on other turbulence.",
)
@option("--quick", is_flag=True, help="Shorter blocks and fewer strengths.")
@option("--output", "-o", metavar="FOLDER", help="Where results go.", show_default="NAME-night")
@WORKERS
@SCHEDULER
@option("--overwrite", is_flag=True, help="Replace another night in the folder.")
def night(
    configuration: str,
    methods: str,
    strengths: str | None,
    strength_factors: str | None,
    tuned: bool,
    quick: bool,
    output: str | None,
    workers: int | None,
    scheduler: str | None,
    overwrite: bool,
) -> None:
    """Alternate with and without TV in a simulated loop, as on the telescope.

    The protocol of the observations of Basden et al. 2015: four sets of cycles, each a block without TV, then
    8 or 20 strengths that rise from 0 to 2; the multiplication gain is full in the first two sets and at 75 %
    in the last two; one atmosphere, whose r0 drifts. The page compares Strehl ratios against time, r0 and
    strength, judges the paper's statements with their significance, and states how many hours of observing
    would show each difference. A run without TV in the same turbulence tells the true difference. An
    interrupted command continues with the sets that are missing.

    \b
    Examples:
      faintspot loop night
      faintspot loop night canary --tuned -o tuned
      faintspot loop night emccd --methods none,tv,smoothed,window --strengths 0.4,0.8
    """
    from faintspot.experiments.night.page import PAGE_FILE, night_summary_text, write_night
    from faintspot.experiments.night.protocol import QUICK_PLAN, NightPlan
    from faintspot.experiments.night.simulated import run_night
    from faintspot.experiments.running import WorkerPool
    from faintspot.loop.simulation.configuration.configuration import load_loop

    loop = load_loop(configuration)
    plan = replace(
        QUICK_PLAN if quick else NightPlan(),
        methods=tuple(name.strip() for name in methods.split(",") if name.strip()),
        strengths_e=() if strengths is None else _numbers(strengths),
        strength_factors=() if strength_factors is None else _factors(strength_factors),
    )
    folder = Path(output or f"{loop.name}-night{'-quick' if quick else ''}")
    with progress_bar("night") as advance:
        pool = WorkerPool(workers, advance, lambda text: click.echo(text, err=True), scheduler)
        result = run_night(loop, folder, plan=plan, quick=quick, tuned=tuned, pool=pool, overwrite=overwrite)
    write_night(result, folder)
    click.echo(night_summary_text(result))
    click.echo(f"{shlex.quote(str(folder / PAGE_FILE))}: open it in a browser")


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise InputError(f"--strengths: expected numbers with commas, got {text!r}") from None


def _factors(path: str) -> tuple[float, ...]:
    from faintspot.io.frames import read_array

    return tuple(read_array(path).ravel().tolist())
