"""Ending of long-running commands by a signal, and the summary of a source of frames."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from faintspot.engine.pixels.readout import CameraReport


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
