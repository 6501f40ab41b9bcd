"""faintspot realtime replay and bridge: recorded frames, and other software's, take the camera's place."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError
from faintspot.cli.commands import FRAMES, KEY, name_option, needs, option
from faintspot.cli.output import progress_bar
from faintspot.cli.realtime.engine_requests import published, stop_on_signal

if TYPE_CHECKING:
    from faintspot.engine.streams.bridge import StreamOut

_HEAD_START_S = 0.5
_DEFAULT_RATE_HZ = 500.0


@click.command("replay", short_help="Publish recorded frames as a camera would.")
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@name_option("Name of the pixel ring.")
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
    "--frames", "n_frames", type=int, metavar="N", help="Number of frames from there on.", show_default="all"
)
@KEY
def replay(
    frames: tuple[str, ...],
    name: str,
    frame_rate_hz: float | None,
    key: str | None,
    time_axis: int | None,
    **options: Any,
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
    from faintspot.engine.frames.pixel_ring import PixelRing
    from faintspot.engine.frames.readout import Replay, ring_type
    from faintspot.engine.processes.child_processes import quick_switching
    from faintspot.io import open_frames

    repeat = options["repeat"]
    waits = frame_rate_hz is None and not repeat
    rate_hz = _DEFAULT_RATE_HZ if frame_rate_hz is None else frame_rate_hz
    with (
        stop_on_signal() as stop,
        quick_switching(),
        open_frames(frames, key=key, time_axis=time_axis) as source,
        PixelRing.create(name, source.shape, ring_type(source.dtype)) as ring,
        Replay(source, ring, frame_rate_hz=rate_hz, waits=waits, **options) as player,
    ):
        rows, columns = source.shape
        often = "repeatedly" if repeat else "once"
        played = options["n_frames"] or source.n_frames - options["first"]
        pace = "every one measured by an engine" if waits else f"{rate_hz:g} frames/s"
        click.echo(
            f"{name}: {rows} x {columns} pixels ({source.dtype} as {ring.dtype}), {played} frames of "
            f"{source.description} {often}, {pace}; Ctrl-C stops"
        )
        if not waits:
            stop.wait(_HEAD_START_S)
        with progress_bar("replay") if not repeat else nullcontext() as advance:
            report = player.run(None, stop, None if advance is None else lambda done: advance(done, played))
    click.echo(f"{name}: {published(report)}, {player.lost} not measured in time")
    if waits and report.frames < played and not stop.is_set():
        click.echo(f"{name}: the engine ended before the last {played - report.frames} frames", err=True)


@needs("realtime", "pyshmem")
@click.command("bridge", short_help="Connect the engine with other software's streams.")
@click.argument("stream", required=False)
@option("--to", "slopes", metavar="STREAM", help="Publish the slopes as isio:NAME.")
@option("--commands-to", "commands", metavar="STREAM", help="Publish the commands as isio:NAME.")
@name_option("Name of the pixel ring and of the engine's streams.")
@FRAMES
def bridge(
    stream: str | None, slopes: str | None, commands: str | None, name: str, frames: int | None
) -> None:
    """Connect `faintspot realtime run` with other software's streams in shared memory.

    Frames of STREAM go into the pixel ring NAME; with --to and --commands-to the engine's slopes
    (all x, then all y, px) and commands come out. Streams are pyshmem's (frames only), or isio:NAME
    of ImageStreamIO (milk, cacao) in $MILK_SHM_DIR, /milk/shm or /tmp.

    The streams may come later, go away and come back, also with frames of another size. Frames keep the
    number that their producer gave them (frame_id; of ImageStreamIO the counter less one); where it
    gives none they are counted, from 0. uint16 frames stay so, other real ones become float32. Ctrl-C ends
    it.

    \b
    Examples, for pyRTC's frames, and for a loop of cacao's:
      faintspot realtime bridge wfs_raw
      faintspot realtime bridge isio:wfsim --to isio:wfsim_slopes
    """
    if not (stream or slopes or commands):
        raise InputError("bridge: expected a stream of frames, --to or --commands-to, got none")
    if frames is not None and not stream:
        raise InputError("--frames: expected a stream of frames, got none")
    from faintspot.engine.processes.child_processes import quick_switching
    from faintspot.engine.streams.bridge import StreamBridge, StreamOut

    def say(line: str) -> None:
        click.echo(f"{name}: {line}")

    outs = {
        what: StreamOut(f"{name}_{what}", target, say)
        for what, target in (("slopes", slopes), ("commands", commands))
        if target
    }
    spins = False if outs else None  # the outputs need processors, too
    with stop_on_signal() as stop, quick_switching() if outs else nullcontext(), _running(outs, stop):
        if stream:
            counters = StreamBridge(stream, name, say=say, spins=spins).run(frames, stop)
        else:
            stop.wait()
    if stream:
        say(
            f"{counters.taken} frames, {counters.missed} missed, {counters.incomplete} incomplete, "
            f"{counters.not_ahead} with a number not ahead; {counters.stalls} stalls, "
            f"{counters.restarts} restarts of the stream"
        )
    for what, out in outs.items():
        say(f"{out.counters.taken} times {what}, {out.counters.missed} missed")


@contextmanager
def _running(outs: Mapping[str, StreamOut], stop: threading.Event) -> Iterator[None]:
    """Run each output in a thread of its own until `stop` is set; the first error sets it and is raised."""
    with ThreadPoolExecutor(max(len(outs), 1)) as threads:
        runs = [threads.submit(out.run, stop) for out in outs.values()]
        for each in runs:
            each.add_done_callback(lambda _: stop.set())
        try:
            yield
        finally:
            stop.set()
    for each in runs:
        each.result()
