"""faintspot realtime replay and bridge: recorded frames, and other software's, take the camera's place."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING

import click

from faintspot.base.errors import InputError
from faintspot.cli.commands import option
from faintspot.cli.needs import needs
from faintspot.cli.progress import progress_bar
from faintspot.cli.realtime_camera import stop_on_signal
from faintspot.cli.shared_options import name_option

if TYPE_CHECKING:
    from faintspot.realtime.bridge import BridgeCounters
    from faintspot.realtime.stream_out import StreamOut

_HEAD_START_S = 0.5
_DEFAULT_RATE_HZ = 500.0
_ENDS_S = 5.0  # a thread looks at whether to stop many times a second
_RING = name_option("Name of the pixel ring.")
_SLOTS = option("--slots", type=int, default=4, help="Frames in the ring.")


@click.command("replay", short_help="Publish recorded frames as a camera would.")
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@_RING
@option(
    "--frame-rate-hz",
    type=float,
    metavar="HZ",
    help="Fixed frame rate; frames that the engine misses are counted.",
    show_default="up to 500, as the engine measures them",
)
@option("--repeat", is_flag=True, help="Begin again at the end, until Ctrl-C.")
@option(
    "--rows-per-block", type=int, metavar="K", help="Row by row, K at a time.", show_default="whole frames"
)
@option("--first", type=int, default=0, help="First frame, counted from 0.")
@option(
    "--frames", "count", type=int, metavar="N", help="Number of frames from there on.", show_default="all"
)
@option("--key", metavar="NAME", help="Which array to read of files that hold several.")
@_SLOTS
def replay(
    frames: tuple[str, ...],
    name: str,
    frame_rate_hz: float | None,
    repeat: bool,
    rows_per_block: int | None,
    first: int,
    count: int | None,
    key: str | None,
    slots: int,
) -> None:
    """Publish recorded frames in the pixel ring NAME, for `faintspot realtime run`.

    FRAMES are FITS files (plain, .gz, .fz; images or cubes), .npy, .npz or Zarr, in the order given, as for
    `faintspot slopes`; they are read ahead in blocks. A frame's number is its place in the sequence.

    By default every frame is measured: replay waits for an engine, publishes up to 500 frames/s, waits where
    the engine is slower, and ends when the engine ends. With --frame-rate-hz or --repeat (500 frames/s) they
    start on a fixed schedule, half a second after the ring is there, and those that the engine misses are
    counted.
    With --rows-per-block rows arrive at the pace of a read-out that takes 80 % of the frame time. Ctrl-C
    ends it.

    \b
    Examples:
      faintspot realtime replay night1.fits night2.fits.gz --frame-rate-hz 300
      faintspot realtime replay cube.npy --frame-rate-hz 1000 --rows-per-block 4 --frames 1000 --repeat
    """
    from faintspot.io import open_frames
    from faintspot.realtime.pixel_ring import PixelRing
    from faintspot.realtime.replay import Replay, ring_type
    from faintspot.realtime.scheduling import quick_switching

    waits = frame_rate_hz is None and not repeat
    with (
        stop_on_signal() as stop,
        quick_switching(),
        open_frames(frames, key=key) as source,
        PixelRing.create(name, source.shape, ring_type(source.dtype), slots=slots) as ring,
        Replay(
            source,
            ring,
            frame_rate_hz=_DEFAULT_RATE_HZ if frame_rate_hz is None else frame_rate_hz,
            first=first,
            n_frames=count,
            repeat=repeat,
            rows_per_block=rows_per_block,
            waits=waits,
        ) as player,
    ):
        rows, columns = source.shape
        often = "repeatedly" if repeat else "once"
        played = count or source.n_frames - first
        pace = (
            "every one measured by an engine" if waits else f"{frame_rate_hz or _DEFAULT_RATE_HZ:g} frames/s"
        )
        click.echo(
            f"{name}: {rows} x {columns} pixels ({source.dtype} as {ring.dtype}), {played} frames of "
            f"{source.description} {often}, {pace}; Ctrl-C stops"
        )
        if not waits:
            stop.wait(_HEAD_START_S)
        with progress_bar("replay") if not repeat else nullcontext() as advance:
            report = player.run(None, stop, _telling(advance, played))
    click.echo(
        f"{name}: {report.frames} frames, {report.frame_rate_hz:.1f} frames/s, {report.late} started late, "
        f"{report.overruns} frame times without a frame, {player.lost} not measured in time"
    )
    if waits and report.frames < played and not stop.is_set():
        click.echo(f"{name}: the engine ended before the last {played - report.frames} frames", err=True)


def _telling(advance: Callable[[int, int], None] | None, total: int) -> Callable[[int], None] | None:
    """Return what tells a progress bar the number of frames."""
    return None if advance is None else lambda published: advance(published, total)


@needs("realtime", "pyshmem")
@click.command("bridge", short_help="Connect the engine with other software's streams.")
@click.argument("stream", required=False)
@option("--from", "source", metavar="STREAM", help="Frames: a pyshmem stream, isio:NAME or dao:FILE.")
@option("--to", "slopes", metavar="STREAM", help="Publish the slopes as isio:NAME or dao:FILE.")
@option("--commands-to", "commands", metavar="STREAM", help="Publish the commands as isio:NAME or dao:FILE.")
@name_option("Name of the pixel ring and of the engine's streams.")
@option("--frames", type=int, metavar="N", help="Stop after this number of frames.", show_default="at Ctrl-C")
@_SLOTS
def bridge(
    stream: str | None,
    source: str | None,
    slopes: str | None,
    commands: str | None,
    name: str,
    frames: int | None,
    slots: int,
) -> None:
    """Connect `faintspot realtime run` with other software's streams in shared memory.

    Frames of STREAM (or --from) go into the pixel ring NAME; with --to and --commands-to the engine's slopes
    (all x, then all y, px) and commands come out. Streams are pyshmem's (frames only), isio:NAME of
    ImageStreamIO (milk, cacao) in $MILK_SHM_DIR, /milk/shm or /tmp, or dao:FILE.

    The streams may come later, go away and come back, also with frames of another size. Frames keep the
    number that their producer gave them (frame_id; of ImageStreamIO and dao the counter less one); where it
    gives none they are counted, from 0. uint16 frames stay so, other real ones become float32. Ctrl-C ends
    it.

    \b
    Examples, for pyRTC's frames, and for a loop of cacao's:
      faintspot realtime bridge wfs_raw
      faintspot realtime bridge --from isio:wfsim --to isio:wfsim_slopes
    """
    if stream and source:
        raise InputError(f"--from {source}: expected it or STREAM, got {stream} as well")
    source = stream or source
    if not (source or slopes or commands):
        raise InputError("bridge: expected a stream of frames, --to or --commands, got none")
    if frames is not None and not source:
        raise InputError("--frames: expected a stream of frames, got none")
    from faintspot.realtime.bridge import StreamBridge
    from faintspot.realtime.scheduling import quick_switching
    from faintspot.realtime.stream_out import StreamOut

    def say(line: str) -> None:
        click.echo(f"{name}: {line}")

    outs = {
        what: StreamOut(f"{name}_{what}", target, say)
        for what, target in (("slopes", slopes), ("commands", commands))
        if target
    }
    counters = None
    with stop_on_signal() as stop, quick_switching() if outs else nullcontext():
        if source and not outs:
            counters = StreamBridge(source, name, say=say, slots=slots).run(frames, stop)
        else:
            counters = _both_ways(source, name, say, slots, frames, list(outs.values()), stop)
    if counters is not None:
        say(
            f"{counters.frames} frames, {counters.missed} missed, {counters.incomplete} incomplete, "
            f"{counters.not_ahead} with a number not ahead; {counters.stalls} stalls, "
            f"{counters.restarts} restarts of the stream"
        )
    for what, out in outs.items():
        say(f"{out.published} times {what}, {out.missed} missed")


def _both_ways(
    source: str | None,
    name: str,
    say: Callable[[str], None],
    slots: int,
    frames: int | None,
    outs: list[StreamOut],
    stop: threading.Event,
) -> BridgeCounters | None:
    """Frames in by this thread, if there are any, the rest by a thread each; the first error ends all."""
    from faintspot.realtime.bridge import StreamBridge

    errors: list[Exception] = []

    def run(out: StreamOut) -> None:
        try:
            out.run(stop)
        except Exception as error:
            errors.append(error)
            stop.set()

    threads = [threading.Thread(target=run, args=(out,), daemon=True) for out in outs]
    for thread in threads:
        thread.start()
    counters = None
    try:
        if source is None:
            stop.wait()
        else:
            counters = StreamBridge(source, name, say=say, slots=slots, spins=False).run(frames, stop)
    finally:
        stop.set()
        for thread in threads:
            thread.join(_ENDS_S)
    if errors:
        raise errors[0]
    return counters
