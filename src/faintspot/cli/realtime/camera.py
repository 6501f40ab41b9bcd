"""faintspot realtime camera: a simulated camera."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from faintspot.cli.shared.commands import SectionedCommand, declared, option
from faintspot.cli.shared.options import FRAMES, READOUT_FRACTION, SLOTS, configuration_option, name_option
from faintspot.slopes.camera.detector import Detector

if TYPE_CHECKING:
    from faintspot.engine.pixels.camera import CameraReport

_KNOWN = "read_noise_e", "em_gain", "gain_e_per_adu", "offset_adu"
_spots = partial(option, section="Spots", type=float)


@click.command(
    "camera", cls=SectionedCommand, short_help="Simulate a camera that publishes frames row by row."
)
@configuration_option("Configuration; its layout says where the spots are.")
@name_option("Name of the pixel ring, in shared memory.")
@option("--frame-rate-hz", type=float, metavar="HZ", default=500.0, help="Frame rate.")
@_spots("--flux-e", default=200.0, metavar="E", help="Electrons per sub-aperture and frame.")
@_spots(
    "--profile",
    type=click.Choice(["diffraction", "gaussian"]),
    default="diffraction",
    help="Shape of the spots.",
)
@_spots("--size", default=1.0, metavar="SIZE", help="Width of the spots; 1 is Nyquist sampling.")
@_spots("--motion-px", default=0.3, metavar="PX", help="Rms motion per axis.")
@_spots("--motion-time-s", default=0.01, metavar="S", help="Correlation time of the motion.")
@declared(Detector, *_KNOWN, sections="Detector", show_default="the configuration's")
@declared(Detector, "background_e", "dark_e", "bits", sections="Detector")
@READOUT_FRACTION
@option("--rows-per-block", type=int, default=4, help="Rows published together.")
@SLOTS
@option("--distinct", "n_distinct", type=int, default=200, help="Frames simulated, then repeated.")
@FRAMES
@option("--seed", type=click.IntRange(0), help="Seed of the simulation.", show_default="another each time")
def camera(config: str, name: str, frames: int | None, slots: int, seed: int | None, **options: Any) -> None:
    """Simulate a camera that publishes frames row by row, for `faintspot realtime run`.

    Spots move about the centres of the sub-apertures; rows become readable one block after the other at the
    pace of a real read-out. Ctrl-C stops it and removes its shared memory. The camera is the one that
    [calibration] describes, so that the slopes are right.

    \b
    Example:
      faintspot realtime camera --config faintspot.toml --frame-rate-hz 1000 --flux-e 50 --read-noise-e 0.5
    """
    import numpy as np

    from faintspot.engine.pixels.camera import SimulatedCamera, SpotMotion, readout_type
    from faintspot.engine.pixels.pixel_ring import PixelRing
    from faintspot.slopes.pipeline.configuration import Configuration

    described = Configuration(config)
    layout, known = described.layout, described.calibration
    values: dict[str, Any] = {
        "read_noise_e": 1.0 if known.read_noise_e is None else known.read_noise_e,
        "em_gain": known.em_gain,
        "gain_e_per_adu": known.gain_e_per_adu,
        "offset_adu": 0.0 if known.dark is None else float(np.nanmean(known.dark)),
    }
    given = {option: options.pop(option) for option in (*values, "dark_e", "background_e", "bits")}
    detector = Detector(**values | {option: value for option, value in given.items() if value is not None})
    motion = SpotMotion(options.pop("motion_px"), options.pop("motion_time_s"))
    dtype = readout_type(detector)
    with PixelRing.create(name, layout.frame_shape, dtype, slots=slots) as ring:
        rng = np.random.default_rng(seed)
        source = SimulatedCamera(layout, ring, detector=detector, motion=motion, rng=rng, **options)
        rows, columns = layout.frame_shape
        click.echo(
            f"{name}: {rows} x {columns} pixels ({dtype}), {len(layout)} sub-apertures, "
            f"{options['frame_rate_hz']:g} frames/s; Ctrl-C stops"
        )
        with stop_on_signal() as stop:
            report = source.run(frames, stop)
    click.echo(f"{name}: {published(report)}")


def published(report: CameraReport) -> str:
    """Describe what a source of frames has published."""
    return (
        f"{report.frames} frames, {report.frame_rate_hz:.1f} frames/s, {report.late} started late, "
        f"{report.overruns} frame times without a frame"
    )


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Give an event that Ctrl-C, or a request to end, sets: the frame under way is completed.

    Python's own handlers run in the main thread, between two of its steps; where that thread waits in
    compiled code, only the system's bytes into a socket, and a thread that reads them, come through.
    """
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    reading, writing = socket.socketpair()
    writing.setblocking(False)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    wakeup = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)

    def listen() -> None:
        if reading.recv(1):
            stop.set()

    listener = threading.Thread(target=listen, name="faintspot-signals", daemon=True)
    listener.start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        writing.close()  # ends the listener
        listener.join()
        reading.close()
