"""faintspot realtime camera: a simulated camera."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from faintspot.cli.shared_options import configuration_option, name_option


@click.command("camera", short_help="Simulate a camera that publishes frames row by row.")
@configuration_option("Configuration; its layout says where the spots are.")
@name_option("Name of the pixel ring, in shared memory.")
@click.option("--rate", type=float, metavar="HZ", default=500.0, show_default=True, help="Frames a second.")
@click.option("--flux-e", type=float, default=200.0, show_default=True, help="Per sub-aperture and frame.")
@click.option(
    "--profile",
    type=click.Choice(["diffraction", "gaussian"]),
    default="diffraction",
    show_default=True,
    help="Shape of the spots.",
)
@click.option(
    "--size", type=float, default=1.0, show_default=True, help="Width of the spots; 1 is Nyquist sampling."
)
@click.option("--motion-px", type=float, default=0.3, show_default=True, help="Standard deviation per axis.")
@click.option("--motion-time", type=float, metavar="S", default=0.01, show_default=True, help="Correlation.")
@click.option("--read-noise-e", type=float, help="At the output. Default: the configuration's, else 1.")
@click.option("--background-e", type=float, default=0.0, show_default=True, help="Per pixel and frame.")
@click.option("--dark-e", type=float, default=0.0, show_default=True, help="Per pixel and frame.")
@click.option("--em-gain", type=float, help="1: no multiplication. Default: the configuration's.")
@click.option("--gain", type=float, metavar="E/ADU", help="Electrons per ADU. Default: the configuration's.")
@click.option("--offset-adu", type=float, help="Level of every pixel. Default: the configuration's dark.")
@click.option("--bits", type=int, help="Bits of the converter, for whole ADU. Default: continuous values.")
@click.option(
    "--readout-fraction",
    type=float,
    default=0.8,
    show_default=True,
    help="Read-out, as a part of the frame time.",
)
@click.option("--rows-per-block", type=int, default=4, show_default=True, help="Rows published together.")
@click.option("--slots", type=int, default=4, show_default=True, help="Frames in the ring.")
@click.option("--distinct", type=int, default=200, show_default=True, help="Frames simulated, then repeated.")
@click.option("--frames", type=int, metavar="N", help="Stop after that many. Default: at Ctrl-C.")
@click.option("--seed", type=click.IntRange(0), help="Seed of the simulation. Default: another each time.")
def camera(config: str, name: str, rate: float, frames: int | None, slots: int, **options: Any) -> None:
    """Simulate a camera that publishes frames row by row, for `faintspot realtime run`.

    Spots move about the centres of the sub-apertures; rows become readable one block after the other at the
    pace of a real read-out. Ctrl-C stops it and removes its shared memory. The camera is the one that
    [calibration] describes, so that the slopes are right.

    \b
    Example:
      faintspot realtime camera --config faintspot.toml --rate 1000 --flux-e 50 --read-noise-e 0.5
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
        gain_e_per_adu=given("gain", known.gain_e_per_adu),
        offset_adu=given("offset_adu", dark),
        bits=options["bits"],
    )
    dtype = readout_type(detector)
    with PixelRing.create(name, layout.frame_shape, dtype, slots=slots) as ring:
        source = Camera(
            layout,
            ring,
            frame_rate_hz=rate,
            flux_e=options["flux_e"],
            detector=detector,
            profile=options["profile"],
            size=options["size"],
            motion=SpotMotion(options["motion_px"], options["motion_time"]),
            readout_fraction=options["readout_fraction"],
            rows_per_block=options["rows_per_block"],
            n_distinct=options["distinct"],
            rng=np.random.default_rng(options["seed"]),
        )
        rows, columns = layout.frame_shape
        click.echo(
            f"{name}: {rows} x {columns} pixels ({dtype}), {len(layout)} sub-apertures, {rate:g} frames/s; "
            "Ctrl-C stops"
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
