"""faintspot realtime camera: a simulated camera."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from faintspot.cli.commands import SectionedCommand, option
from faintspot.cli.shared_options import configuration_option, name_option

_SPOTS, _DETECTOR, _KNOWN = "Spots", "Detector", "the configuration's"


@click.command(
    "camera", cls=SectionedCommand, short_help="Simulate a camera that publishes frames row by row."
)
@configuration_option("Configuration; its layout says where the spots are.")
@name_option("Name of the pixel ring, in shared memory.")
@option("--frame-rate-hz", type=float, metavar="HZ", default=500.0, help="Frame rate.")
@option(
    "--flux-e",
    type=float,
    metavar="E",
    default=200.0,
    help="Electrons per sub-aperture and frame.",
    section=_SPOTS,
)
@option(
    "--profile",
    type=click.Choice(["diffraction", "gaussian"]),
    default="diffraction",
    help="Shape of the spots.",
    section=_SPOTS,
)
@option(
    "--size",
    type=float,
    metavar="SIZE",
    default=1.0,
    help="Width of the spots; 1 is Nyquist sampling.",
    section=_SPOTS,
)
@option("--motion-px", type=float, metavar="PX", default=0.3, help="Rms motion per axis.", section=_SPOTS)
@option(
    "--motion-time-s",
    type=float,
    metavar="S",
    default=0.01,
    help="Correlation time of the motion.",
    section=_SPOTS,
)
@option(
    "--read-noise-e",
    type=float,
    metavar="E",
    help="Read noise at the output.",
    show_default="the configuration's, else 1",
    section=_DETECTOR,
)
@option(
    "--background-e", type=float, metavar="E", default=0.0, help="Sky per pixel and frame.", section=_DETECTOR
)
@option(
    "--dark-e",
    type=float,
    metavar="E",
    default=0.0,
    help="Dark current per pixel and frame.",
    section=_DETECTOR,
)
@option(
    "--em-gain", type=float, metavar="G", help="EM gain; 1: none.", show_default=_KNOWN, section=_DETECTOR
)
@option(
    "--gain-e-per-adu",
    type=float,
    metavar="E/ADU",
    help="Electrons per ADU.",
    show_default=_KNOWN,
    section=_DETECTOR,
)
@option(
    "--offset-adu",
    type=float,
    metavar="ADU",
    help="Level of every pixel.",
    show_default="the configuration's dark",
    section=_DETECTOR,
)
@option(
    "--bits",
    type=int,
    help="Bits of the converter, for whole ADU.",
    show_default="continuous values",
    section=_DETECTOR,
)
@option(
    "--readout-fraction",
    type=float,
    metavar="PART",
    default=0.8,
    help="Read-out, as a part of the frame time.",
)
@option("--rows-per-block", type=int, default=4, help="Rows published together.")
@option("--slots", type=int, default=4, help="Frames in the ring.")
@option("--distinct", type=int, default=200, help="Frames simulated, then repeated.")
@option("--frames", type=int, help="Stop after this number of frames.", show_default="at Ctrl-C")
@option("--seed", type=click.IntRange(0), help="Seed of the simulation.", show_default="another each time")
def camera(
    config: str, name: str, frame_rate_hz: float, frames: int | None, slots: int, **options: Any
) -> None:
    """Simulate a camera that publishes frames row by row, for `faintspot realtime run`.

    Spots move about the centres of the sub-apertures; rows become readable one block after the other at the
    pace of a real read-out. Ctrl-C stops it and removes its shared memory. The camera is the one that
    [calibration] describes, so that the slopes are right.

    \b
    Example:
      faintspot realtime camera --config faintspot.toml --frame-rate-hz 1000 --flux-e 50 --read-noise-e 0.5
    """
    import numpy as np

    from faintspot.camera.calibration import Calibration
    from faintspot.realtime.camera import Camera, SpotMotion, readout_type
    from faintspot.realtime.pixel_ring import PixelRing
    from faintspot.sensor.layout import Layout
    from faintspot.simulate import Detector

    layout, known = Layout.load(config), Calibration.load(config)
    dark = 0.0 if known.dark is None else float(np.nanmean(known.dark))

    def given(option: str, otherwise: float) -> float:
        value: float | None = options[option]
        return otherwise if value is None else value

    detector = Detector(
        given("read_noise_e", 1.0 if known.read_noise_e is None else known.read_noise_e),
        dark_e=options["dark_e"],
        background_e=options["background_e"],
        em_gain=given("em_gain", known.em_gain),
        gain_e_per_adu=given("gain_e_per_adu", known.gain_e_per_adu),
        offset_adu=given("offset_adu", dark),
        bits=options["bits"],
    )
    dtype = readout_type(detector)
    with PixelRing.create(name, layout.frame_shape, dtype, slots=slots) as ring:
        source = Camera(
            layout,
            ring,
            frame_rate_hz=frame_rate_hz,
            flux_e=options["flux_e"],
            detector=detector,
            profile=options["profile"],
            size=options["size"],
            motion=SpotMotion(options["motion_px"], options["motion_time_s"]),
            readout_fraction=options["readout_fraction"],
            rows_per_block=options["rows_per_block"],
            n_distinct=options["distinct"],
            rng=np.random.default_rng(options["seed"]),
        )
        rows, columns = layout.frame_shape
        click.echo(
            f"{name}: {rows} x {columns} pixels ({dtype}), {len(layout)} sub-apertures, "
            f"{frame_rate_hz:g} frames/s; Ctrl-C stops"
        )
        with stop_on_signal() as stop:
            report = source.run(frames, stop)
    click.echo(
        f"{name}: {report.frames} frames, {report.frame_rate_hz:.1f} frames/s, {report.overruns} overruns"
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
