"""faintspot demo: a simulated faint star, with and without denoising."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from rich.console import Console

from faintspot.base.errors import InputError
from faintspot.base.files import write_atomically
from faintspot.base.report.texts import with_interval
from faintspot.cli.commands import can_make, option
from faintspot.cli.output import progress_bar, results_table
from faintspot.experiments import demonstration
from faintspot.experiments.demonstration import Comparison
from faintspot.io.slopes import read_slopes
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.measuring import measure_recorded

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.table import Table

    from faintspot.slopes.pipeline.slopes import Stages
    from faintspot.slopes.recorded.statistics import MeasuredSlopes
    from faintspot.slopes.sensor.layout import Layout


@click.command()
@option("--output", "-o", default="faintspot-demo", help="Folder for what it makes.")
@option("--frames", type=click.IntRange(20), default=600, help="Frames at each flux.")
@option("--seed", type=click.IntRange(0), default=2015, help="Seed of the simulation.")
def command(output: str, frames: int, seed: int) -> None:
    """Simulate a faint star, measure it with and without denoising, and write a report.

    A CANARY-like sensor: 7 x 7 sub-apertures of which 36 are illuminated, 16 x 16 pixels, Nyquist-sampled
    diffraction spots at random known positions, an EMCCD at gain 500. Brightest pixels and centre of gravity
    are measured with and without denoising at six fluxes. Number of pixels kept and strength are chosen on
    one half of the frames and scored on the other.

    The folder then holds the frames of one flux, their configuration, both sets of slopes and the report
    page, made by the same commands that you would use on frames of your own. The page needs the extra
    `report`. `faintspot realtime demo` shows the closed loop in real time.

    \b
    Example:
      faintspot demo -o /tmp/demo --frames 2000
    """
    folder = Path(output)
    with_report = can_make("report page", "matplotlib", "jinja2")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be made a folder ({error.strerror or error})") from None
    rng = np.random.default_rng(seed)
    with progress_bar("simulating and measuring", "fluxes") as advance:
        comparisons = demonstration.compare(frames, rng, advance)
    console = Console()
    for comparison in comparisons:
        console.print(comparison_table(comparison, rng))
    page_parts = write_files(folder, comparisons[0], frames, rng)
    if with_report:
        write_page(folder, **page_parts)
        click.echo(f"{folder / 'report.html'}: open it in a browser")
    else:
        click.echo(f"{folder}: frames, configurations and slopes")
    click.echo(
        "With frames of your own: faintspot layout --help; in real time, on a page: faintspot realtime demo"
    )


def comparison_table(comparison: Comparison, rng: np.random.Generator) -> Table:
    """Return the slope errors with and without denoising and the flux gain as a table."""
    gain = comparison.flux_gain(rng)
    saved_mag = gain.in_magnitudes
    saved = (
        f"denoising saves a factor {gain.in_words()} of flux: {with_interval(saved_mag, 2)} mag"
        if 0 < gain.factor < np.inf
        else "no flux that was simulated gives the same error with denoising"
    )
    table = results_table("e-", "R without", "R with TV", "difference", "k", "k, TV", "strength")
    table.title = f"Slope error R (mean |error| per axis, px), {comparison.mode}"
    table.caption = f"At {demonstration.SHOWN_FLUX_E:g} e-, {saved}"
    for i, flux in enumerate(demonstration.FLUXES_E):
        without, denoised = comparison.without[i], comparison.denoised[i]
        table.add_row(
            f"{flux:g}",
            *(
                f"{estimate.value:.4f} ± {estimate.standard_error:.4f}"
                for estimate in (without.slope_error, denoised.slope_error, comparison.difference(i))
            ),
            str(without.settings.keep_brightest),
            str(denoised.settings.keep_brightest),
            f"{denoised.settings.noise_std:.2f}",
        )
    return table


def write_files(
    folder: Path, comparison: Comparison, n_frames: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Write new frames at one flux, measure them with and without denoising; return what it shows."""
    from faintspot.slopes.recorded.statistics import MeasuredSlopes

    layout = demonstration.demonstration_layout()
    shown = demonstration.FLUXES_E.index(demonstration.SHOWN_FLUX_E)
    frames, truth = demonstration.simulate(layout, demonstration.SHOWN_FLUX_E, n_frames, rng)
    for name, values in (("frames", frames), ("truth", truth)):
        write_atomically(folder / f"{name}.npy", partial(np.save, arr=values))
    methods, stages = [], {}
    for name, chosen in (("TV", comparison.denoised[shown]), ("no TV", comparison.without[shown])):
        stem = name.lower().replace(" ", "-")
        config = folder / f"{stem}.toml"
        for item in (layout, chosen.settings, demonstration.CALIBRATION):
            configuration.save(config, item)
        output = folder / f"{stem}.npz"
        with progress_bar(f"slopes, {name}") as advance:
            measure_recorded([folder / "frames.npy"], config, output, overwrite=True, progress=advance)
        methods.append(MeasuredSlopes(name, Slopes.from_variables(read_slopes(output).variables)))
        stages[name] = SlopePipeline.from_file(config).explain(frames[0])
    return {"methods": methods, "layout": layout, "stages": stages, "truth": truth}


def write_page(
    folder: Path,
    methods: list[MeasuredSlopes],
    layout: Layout,
    stages: dict[str, Stages],
    truth: NDArray[np.float64],
) -> None:
    """Make the report."""
    from faintspot.slopes.recorded.page import SlopesRun, slopes_report
    from faintspot.slopes.recorded.pictures import Example

    facts = {
        "Source": "simulated, with known truth",
        "Flux": f"{demonstration.SHOWN_FLUX_E:g} e- per sub-aperture and frame",
        "Positions": f"uniform within +-{demonstration.POSITION_RANGE_PX:g} px",
        "Camera": "EMCCD, gain 500, read noise 45 e- at the output (0.09 e- referred to photo-electrons)",
    }
    report = slopes_report(
        SlopesRun(methods, layout, Example(layout, stages, 0, truth[0]), truth),
        title="faintspot demonstration",
        facts=facts,
        configurations={"Configuration": (folder / "tv.toml").read_text(encoding="utf-8")},
    )
    report.write(folder / "report.html")
