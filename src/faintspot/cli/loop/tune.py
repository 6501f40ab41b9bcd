"""faintspot loop tune: which estimator and control, for a closed loop."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from faintspot.base.errors import InputError
from faintspot.cli.shared.commands import NAMES, Listed, option
from faintspot.cli.shared.experiments import experiment_options, worker_pool
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.output import check_target, picture_file, results_table, wrapped, write_picture

if TYPE_CHECKING:
    from rich.table import Table

    from faintspot.experiments.closed_loop.answer import LoopAnswer
    from faintspot.experiments.closed_loop.question import LoopQuestion


@needs("loop", "hcipy", "joblib", "zarr", "matplotlib", "jinja2")
@click.command("tune", short_help="Recommend an estimator and a control for a closed loop.")
@click.argument("configuration", metavar="CONFIG")
@option("--magnitude", type=float, metavar="MAG", help="Magnitude of the guide star.", show_default="CONFIG")
@option(
    "--flux-e",
    type=float,
    metavar="E",
    help="Flux of the guide star instead: photo-electrons per sub-aperture and frame.",
)
@option(
    "--magnitudes",
    type=Listed(float, (2,), "the first and the last, such as 8,14"),
    metavar="FIRST,LAST",
    help="Range of stars to simulate.",
    show_default="four times to an eighth of the star's flux",
)
@option(
    "--methods",
    type=NAMES,
    metavar="NAMES",
    help="Candidates, with commas, as for `loop magnitude`.",
    show_default="all that suit",
)
@option(
    "--strehl",
    type=float,
    metavar="S",
    help="Strehl ratio that the limiting magnitudes are for.",
    show_default="half of that of a bright star",
)
@option(
    "--radius-arcsec",
    type=float,
    metavar="ARCSEC",
    help="Distance up to which a star serves, for the sky coverage.",
    show_default="the isoplanatic angle",
)
@option("--seed", type=click.IntRange(0), help="Seed of turbulence and noise.", show_default="CONFIG")
@option(
    "--results", metavar="FOLDER", help="Folder of finished work, to continue from.", show_default="NAME-tune"
)
@option("--output", "-o", metavar="TOML", default="faintspot.toml", help="Configuration to write.")
@option("--picture", metavar="PNG", help="Plot to write.", show_default="beside the output, with -tune.png")
@experiment_options
def tune(
    configuration: str,
    results: str | None,
    output: str,
    picture: str | None,
    overwrite: bool,
    workers: int | None,
    scheduler: str | None,
    **options: object,
) -> None:
    """Recommend an estimator and a control for a closed loop.

    Estimators and control are tuned in quick simulations of the loop and compared by their Strehl ratio,
    limiting magnitude and sky coverage, with a fixed window and an integrator as the baseline. A few minutes;
    interrupted, the same command continues.

    \b
    Examples:
      faintspot loop tune diffraction_limit
      faintspot loop tune mine.toml --magnitudes 8,14 --strehl 0.3
    """
    target = Path(output)
    check_target(target, overwrite)
    drawing = picture_file(target, picture, "-tune.png")
    question = _question(configuration, options)
    from faintspot.experiments.closed_loop.tuning import tune_loop
    from faintspot.loop.simulation.engine_files import CONFIGURATION as ENGINE_FILE

    folder = results or f"{question.configuration.name}-tune"
    with worker_pool("loop", workers, scheduler) as pool:
        answer = tune_loop(question, folder, pool=pool, overwrite=overwrite)
    show(answer)
    loop = answer.save(target)
    click.echo(f"{target}: written, and {loop}, the loop with this star and gain")
    if drawing is not None:
        from faintspot.experiments.planner.figures import loop_figure

        write_picture(loop_figure(answer), drawing)
    names, photons = (
        ",".join(dict.fromkeys(["brightest", "window", answer.best.name])),
        f"{answer.photons[answer.at_star]:g}",
    )
    command = shlex.join(["faintspot", "loop", "magnitude", str(loop), "--methods", names])
    click.echo(f"Next, a long search and long runs: {command} --flux-e {photons}")
    if target.name == ENGINE_FILE:
        folder, control = str(target.parent), answer.best.control
        command = shlex.join(["faintspot", "loop", "engine", str(loop), "-o", folder, "--control", control])
        click.echo(f"In real time: {command}")


def show(answer: LoopAnswer) -> None:
    """Print the answer."""
    from faintspot.experiments.closed_loop import text as loop_text

    console = Console(highlight=False)

    def say(lines: list[str], indent: str = "") -> None:
        for line in wrapped(lines, console, indent):
            click.echo(line)

    say([loop_text.situation(answer)])
    console.print(strehl_table(answer))
    heading, *rest = loop_text.recommendation(answer)
    say([heading])
    say(rest, "  ")
    console.print(gain_table(answer))
    say([loop_text.about_the_limits(answer)], "  ")
    if answer.question.radius is not None:
        console.print(sky_table(answer))
    say(loop_text.about_the_sky(answer), "  ")
    click.echo("This rests on")
    say(loop_text.foundations(answer), "  ")


def strehl_table(answer: LoopAnswer) -> Table:
    """Return the Strehl ratios of all candidates at all measured magnitudes as a table."""
    from faintspot.base.report.words import plain_number

    fluxes = list(reversed(range(len(answer.photons))))
    stars = (f"{answer.magnitudes[flux]:.2f}\n{plain_number(answer.photons[flux])} e-" for flux in fluxes)
    table = results_table("method", *stars)
    for name in answer.kinds:
        values = [answer.strehl(name, flux) for flux in fluxes]
        texts = [f"{each.value:.3f}±{each.standard_error:.3f}".removesuffix("±nan") for each in values]
        table.add_row(name, *texts, style="bold" if name == answer.best.name else None)
    table.caption = "Strehl ratio and its standard error, at magnitudes that were measured."
    return table


def gain_table(answer: LoopAnswer) -> Table:
    """Return limiting magnitudes and what is gained over both references as a table."""
    from faintspot.experiments.closed_loop import text as loop_text
    from faintspot.experiments.closed_loop.question import REFERENCES

    table = results_table("method", "limiting\nmagnitude", "mag over\nwindow", "mag over\nbrightest")
    for name in answer.kinds:
        cells = [loop_text.limit_in_words(answer, name)]
        for reference in REFERENCES:
            same = name == reference
            cells.append("" if same else loop_text.gain_in_words(answer, name, reference))
        table.add_row(name, *cells, style="bold" if name == answer.best.name else None)
    return table


def sky_table(answer: LoopAnswer) -> Table:
    """Return the fraction of the sky that every candidate opens as a table."""
    from faintspot.experiments.closed_loop import text as loop_text
    from faintspot.experiments.closed_loop.question import PLACES

    table = results_table("method", *(f"{place}\n%" for place in PLACES))
    for name in answer.kinds:
        found = [answer.coverage(name, place) for place in PLACES]
        cells = [loop_text.coverage_in_words(each) for each in found if each is not None]
        table.add_row(name, *cells, style="bold" if name == answer.best.name else None)
    return table


def _question(config: str, options: dict[str, Any]) -> LoopQuestion:
    from faintspot.experiments.closed_loop.question import LoopQuestion
    from faintspot.loop.simulation.configuration.configuration import load_loop

    loop = load_loop(config)
    if options["magnitude"] is not None and options["flux_e"] is not None:
        raise InputError("--magnitude, --flux-e: expected one of them, got both")
    if options["magnitude"] is not None:
        loop = loop.replace("camera", magnitude=options["magnitude"], photons_per_subaperture=None)
    if options["flux_e"] is not None:
        loop = loop.replace("camera", photons_per_subaperture=options["flux_e"], magnitude=None)
    if options["seed"] is not None:
        loop = loop.replace("run", seed=options["seed"])
    kept = {name: options[name] for name in ("magnitudes", "methods", "strehl", "radius_arcsec")}
    return LoopQuestion(loop, **kept)
