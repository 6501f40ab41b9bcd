"""Requests to a running engine or telescope, and their answers in words."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from faintspot.engine.processes.requests import ENGINE, LENGTHY_TIMEOUT_S, request, socket_path

if TYPE_CHECKING:
    from faintspot.engine.frames.readout import CameraReport


PATIENCE_S = 2.0
"""Delay before the reason for waiting is printed."""


def asked(name: str, command: str, kind: str = ENGINE, /, **fields: Any) -> dict[str, Any]:
    """Ask the engine or telescope of that name; see `faintspot.engine.processes.requests.request`."""
    return request(socket_path(name, kind), command, **fields)


def asked_at_length(name: str, command: str, **fields: object) -> dict[str, Any]:
    """Ask for a change, for which the engine may compile."""
    reason = "waiting: the engine goes on, and compiles what this machine has not used yet"
    timer = threading.Timer(PATIENCE_S, click.echo, [reason], {"err": True})
    timer.daemon = True
    timer.start()
    try:
        return asked(name, command, timeout_s=LENGTHY_TIMEOUT_S, **fields)
    finally:
        timer.cancel()


def loop_in_words(loop: Mapping[str, object]) -> str:
    """Describe the state of a loop."""
    if loop["state"] == "none":
        return "no loop: the engine makes no commands"
    gain = "" if loop["gain"] is None else f", gain {loop['gain']:g}"
    text = f"loop {loop['state']}: {loop['controller']}{gain}"
    if obstacle := loop["obstacle"] or loop["opened_because"]:
        return f"{text}; {obstacle}"
    again = f"; again, it had been opened: {before}" if (before := loop["closed_again_because"]) else ""
    return f"{text}, slopes of {loop['residual_px']:.2f} px rms{again}"


def learnt_in_words(learning: dict[str, Any]) -> str:
    """Describe the latest learning beside an engine."""
    if "found" not in learning:
        return f"not again: {learning['fault']}"
    seconds, fault = time.time() - learning["unix_time_s"], learning.get("fault")
    taken = f"refused: {fault}" if fault else "taken" if learning["taken"] else "not taken"
    return f"{seconds:.0f} s ago: {learning['found']}; {taken}"


def summary(reply: dict[str, Any]) -> str:
    """Summarise the counters and latencies of an engine."""
    counters, latency = reply["counters"], reply["latency"]
    lost = counters["dropped"] + counters["skipped"]
    lines = [
        f"{reply['name']}: {counters['processed']} frames measured, {lost} lost, {counters['late']} late"
    ]
    for what in ("late", "lost"):
        if counts := reply[f"{what}_because"]:
            causes = ", ".join(f"{cause} {count}" for cause, count in counts.items())
            lines.append(f"{what} because: {causes}")
    lines += [f"{title}: {text}" for title, text in notes(reply).items()]
    if reply["loop"]["state"] != "none":
        lines.append(loop_in_words(reply["loop"]))
    if latency["count"]:
        lines.append(
            f"from the last row to the slopes: p50 {latency['p50_us']:.0f} us, "
            f"p99 {latency['p99_us']:.0f}, p99.9 {latency['p99_9_us']:.0f}, largest {latency['max_us']:.0f}"
        )
    return "\n  ".join(lines)


def notes(reply: dict[str, Any]) -> dict[str, str]:
    """Return what is unusual about an engine: faults, and settings that are being prepared."""
    found = {key.replace("_", " "): reply[key] for key in ("source_refused", "estimator_fault") if reply[key]}
    if learning := reply["learning"]:
        found["learnt"] = learnt_in_words(learning)
    if reply["preparing"]:
        names, seconds = ", ".join(reply["preparing"]["changes"]), reply["preparing"]["seconds"]
        found["preparing"] = f"{names} (for {seconds:.0f} s)"
    return found


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
