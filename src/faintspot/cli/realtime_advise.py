"""faintspot realtime advise: what a running loop's telemetry tells, and what may be better."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError
from faintspot.base.extras import require_linux
from faintspot.cli.needs import needs
from faintspot.cli.realtime_camera import stop_on_signal
from faintspot.cli.shared_options import ENGINE_NAME, configuration_option

if TYPE_CHECKING:
    from faintspot.advice.advising import Advice
    from faintspot.advice.trial import Loop
    from faintspot.pipeline.settings import Settings


@needs("realtime", "pyshmem", "zarr")
@click.command("advise", short_help="Say what telemetry tells, and what would be better.")
@configuration_option("Configuration of the engine.")
@ENGINE_NAME
@click.option(
    "--seconds",
    type=click.FloatRange(1),
    default=10.0,
    show_default=True,
    help="Seconds of telemetry to look at; each trial takes three times as long.",
)
@click.option(
    "--from",
    "store",
    type=click.Path(path_type=Path),
    metavar="STORE",
    help="A recording, instead of a running engine.",
)
@click.option("--apply", "tries", is_flag=True, help="Try it on the running loop, and keep what is better.")
def advise(config: str, name: str, seconds: float, store: Path | None, tries: bool) -> None:
    """Say what the telemetry of a closed loop tells of star, camera and air, and what may be better.

    Light, noise, width of the spots, centroid gain, r0, wind and vibrations, with errors, as far as telemetry
    has them; light and centroid gain need images (run --images-every). Proposed are the light that the
    estimator is told, the loop gain that would have left least, and the estimator that the planner finds best
    for this light and these spots.

    With --apply each proposal takes turns with the present settings. They are compared by the wavefront that
    they leave, without the noise of the slopes that tell it; what is better beyond the error is kept,
    everything else taken back. TOML's name with .advice.json says what was done.

    \b
    Examples:
      faintspot realtime advise
      faintspot realtime advise --apply
      faintspot realtime advise --from night.zarr
    """
    from faintspot.advice.advising import advise as advised
    from faintspot.advice.advising import apply, loop_of, write_journal
    from faintspot.cli.progress import progress_bar

    if store is None:
        require_linux("realtime advise without --from")
    if tries and store is not None:
        raise InputError("--apply, --from: expected one of them; a recording cannot be changed")
    loop, written = loop_of(config, name)
    with stop_on_signal() as stop:
        telemetry, settings, gain = (
            _recorded(store, written, loop) if store is not None else _running(loop, seconds, stop)
        )
        if stop.is_set():
            return
        with progress_bar("planner", "steps") as advance:
            advice = advised(loop, telemetry, settings, gain, advance)
        said = _said(advice, settings)
        click.echo("\n".join(said))
        told = store is None and _tell(loop, said)
        try:
            if tries:
                apply(loop, advice, 3 * seconds, stop, click.echo)
        finally:
            if told:
                tried = zip(advice.proposals, advice.verdicts, strict=False)
                _tell(loop, [*said, *(f"{each.text}: {how.in_words(loop.unit)}" for each, how in tried)])
            place = write_journal(config, advice.entry(name, loop.unit))
            click.echo(f"{place} written")


def _said(advice: Advice, settings: Settings) -> list[str]:
    """Return the advice as lines."""
    lines = [f"{advice.frames} frames with {settings.estimator.name}"]
    lines += [f"  {known.in_words()}" for known in advice.known]
    lines += [f"{proposal.text}: {proposal.promise}" for proposal in advice.proposals]
    return lines if advice.proposals else [*lines, "nothing to propose"]


def _tell(loop: Loop, lines: list[str]) -> bool:
    """Have the engine say the advice to whoever watches it; return whether it could be asked."""
    try:
        loop.ask("advice", lines=lines)
    except InputError:  # it has ended: that is said elsewhere
        return False
    return True


def _running(loop: Loop, seconds: float, stop: Any) -> tuple[Any, Settings, float | None]:
    """Watch the running engine."""
    from faintspot.advice.watching import watch

    status = loop.ask("status")
    if len(status["arms"]) > 1:
        raise InputError(f"{loop.name}: expected no arms in turn; faintspot realtime interleave set ends it")
    loop.check()
    telemetry = watch(loop.name, seconds, stop)
    return telemetry, loop.settings(), loop.ask("loop", action="status")["loop"]["gain"]


def _recorded(store: Path, written: Settings, loop: Loop) -> tuple[Any, Settings, float | None]:
    """Read a recording; its settings are those at its end."""
    from faintspot.advice.watching import recorded_settings
    from faintspot.io import read_telemetry

    telemetry = read_telemetry(store)
    return recorded_settings(telemetry, loop.control.options.gain)
