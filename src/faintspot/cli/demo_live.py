"""faintspot demo --live: telescope, engine and page together."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

from faintspot.base.errors import MissingExtraError
from faintspot.base.extras import present, require_linux
from faintspot.cli.realtime_camera import stop_on_signal

if TYPE_CHECKING:
    from faintspot.experiments.statistics import Estimate
    from faintspot.live_page.demonstration import ArmShown, Shown

NAMES = ("seconds", "rate", "photons", "name", "port")
"""Options that only --live has."""
SHARED = ("output", "seed")
"""Options that both demonstrations have."""
_NEEDED = {"realtime": ("pyshmem",), "live": ("tornado", "zarr"), "loop": ("hcipy",)}


def live_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that only --live has."""
    for option in (
        click.option(
            "--port",
            type=click.IntRange(0, 65535),
            default=8642,
            show_default=True,
            help="Live: port of the page; 0: any that is free.",
        ),
        click.option(
            "--name", default="faintspot", show_default=True, help="Live: name of the engine and its streams."
        ),
        click.option(
            "--photons",
            type=float,
            default=100.0,
            show_default=True,
            help="Live: photons per sub-aperture and frame.",
        ),
        click.option(
            "--rate",
            type=float,
            metavar="HZ",
            default=100.0,
            show_default=True,
            help="Live: frames per second.",
        ),
        click.option(
            "--seconds",
            type=click.FloatRange(0, min_open=True),
            default=60.0,
            show_default=True,
            help="Live: how long the loop is closed; then there is a table.",
        ),
        click.option("--live", is_flag=True, help="Run telescope, real-time engine and its page instead."),
    ):
        command = option(command)
    return command


def show_live(options: dict[str, Any]) -> None:
    """Run the demonstration and print its table."""
    require_linux("demo --live")
    _check_extras()
    from faintspot.live_page.demonstration import LiveDemonstration

    plan = LiveDemonstration(
        Path(options["output"]),
        options["photons"],
        options["rate"],
        options["name"],
        options["port"],
        options["seed"],
    )
    with stop_on_signal() as stop:
        shown = plan.run(stop, options["seconds"], click.echo)
    arms = shown.by_arm()
    if arms:
        Console().print(arms_table(arms))
    for line in in_words(shown):
        click.echo(line)


def arms_table(arms: list[ArmShown]) -> Table:
    """Return what every arm has done as a table."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("arm", no_wrap=True)
    for heading in ("Strehl ratio", f"over {arms[0].strehl.arm}", "p50", "p99", "frames"):
        table.add_column(heading, justify="right", no_wrap=True)
    for arm in arms:
        difference = arm.strehl.difference
        table.add_row(
            arm.strehl.arm,
            _plus_minus(arm.strehl.mean, ""),
            "" if difference is None else _plus_minus(difference, "+"),
            f"{arm.p50_us:.0f}",
            f"{arm.p99_us:.0f}",
            str(arm.frames),
        )
    table.caption = "Standard errors from blocks of turns; p50, p99 from the last row to the slopes, us."
    table.caption_justify = "left"
    return table


def _check_extras() -> None:
    """Make sure that all that is needed is installed; one line says all that is not."""
    missing = {
        extra: [package for package in packages if not present(package)]
        for extra, packages in _NEEDED.items()
    }
    missing = {extra: packages for extra, packages in missing.items() if packages}
    if missing:
        packages = " and ".join(package for each in missing.values() for package in each)
        raise MissingExtraError(packages, ",".join(missing), "faintspot demo --live")


def in_words(shown: Shown) -> list[str]:
    """Say what has happened, besides the table."""
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
    if not shown.by_arm():
        lines.append("ended before every arm had its turn")
    return lines


def _plus_minus(value: Estimate, sign: str) -> str:
    text = f"{value.value:{sign}.3f}"
    return f"{text} ± {value.standard_error:.3f}" if math.isfinite(value.standard_error) else text
