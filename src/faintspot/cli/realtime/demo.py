"""faintspot realtime demo: telescope, engine and page together."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from faintspot.cli.shared.commands import PORT, name_option, option
from faintspot.cli.shared.engine_requests import stop_on_signal
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.output import results_table

if TYPE_CHECKING:
    from rich.table import Table

    from faintspot.base.statistics import Estimate
    from faintspot.engine.page.demonstration import MethodShown, Shown


@needs("realtime,loop", "pyshmem", "tornado", "zarr", "hcipy")
@click.command("demo", short_help="Run a simulated telescope, the engine and its page together.")
@name_option("Name of the engine and its streams.")
@option("--output", "-o", metavar="FOLDER", default="faintspot-demo", help="Folder for what it makes.")
@option(
    "--flux-e", type=float, metavar="E", default=100.0, help="Photo-electrons per sub-aperture and frame."
)
@option("--frame-rate-hz", type=float, metavar="HZ", default=100.0, help="Frame rate.")
@option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    default=60.0,
    help="Time for which the loop is closed; then there is a table.",
)
@PORT
@option("--seed", type=click.IntRange(0), default=2015, help="Seed of the simulation.")
def demo(
    name: str, output: str, flux_e: float, frame_rate_hz: float, seconds: float, port: int, seed: int
) -> None:
    """Run a simulated telescope, the real-time engine and its web page together.

    The loop is closed on a faint star, methods alternate, and a table at the end gives the Strehl ratio of
    each. Needs the extras `realtime` and `loop`.
    """
    from faintspot.engine.page.demonstration import LiveDemonstration

    plan = LiveDemonstration(Path(output), flux_e, frame_rate_hz, name, port, seed)
    with stop_on_signal() as stop:
        shown = plan.run(stop, seconds, click.echo)
    methods = shown.by_method()
    if methods:
        Console().print(methods_table(methods))
    for line in in_words(shown):
        click.echo(line)


def methods_table(methods: list[MethodShown]) -> Table:
    """Return what every method has done as a table."""
    columns = ("Strehl ratio", f"over {methods[0].strehl.method}", "p50", "p99", "frames")
    table = results_table("method", *columns)
    for method in methods:
        difference = method.strehl.difference
        table.add_row(
            method.strehl.method,
            _plus_minus(method.strehl.mean, ""),
            "" if difference is None else _plus_minus(difference, "+"),
            f"{method.p50_us:.0f}",
            f"{method.p99_us:.0f}",
            str(method.frames),
        )
    table.caption = "Standard errors from blocks of turns; p50, p99 from the last row to the slopes, us."
    return table


def in_words(shown: Shown) -> list[str]:
    """Describe the run, besides the table."""
    status = shown.status
    if status is None:
        return ["ended before there was a loop"]
    counters, loop = status["counters"], status["loop"]
    lost = counters["dropped"] + counters["skipped"]
    latency = loop["latency"]
    lines = [
        f"{counters['processed']} frames measured, {lost} lost; from the last row to the commands p50 "
        f"{latency['p50_us']:.0f} us, p99 {latency['p99_us']:.0f} us"
    ]
    if math.isfinite(shown.on_time):
        lines.append(
            f"the commands acted after the delay that is set in {100 * shown.on_time:.1f} % of frames"
        )
    if math.isfinite(shown.open_strehl):
        lines.append(f"Strehl ratio of the open loop: {shown.open_strehl:.3f}")
    if loop["opened_because"]:
        lines.append(f"the loop was opened: {loop['opened_because']}")
    if not shown.by_method():
        lines.append("ended before every method had its turn")
    return lines


def _plus_minus(value: Estimate, sign: str) -> str:
    text = f"{value.value:{sign}.3f}"
    return f"{text} ± {value.standard_error:.3f}" if math.isfinite(value.standard_error) else text
