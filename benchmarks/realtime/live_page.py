"""What does the engine notice of a page that is watched?

Camera, engine and page run as processes of their own; four clients of the page read all that comes, and one
does not read at all. The page takes turns of some seconds with its absence (it is stopped, and goes on), in
one run of the engine, so that both see the same neighbours. Latencies are those of the engine's own records,
from the last row's arrival to the slopes' publication; they are read once at each turn's end.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from benchmarks.measuring import Row, Table, Times, median_ratio, spread
from benchmarks.realtime.realtime_processes import SMALL, USUAL, engine_and_camera
from faintspot.engine.telemetry.ring import TelemetryRing

RATE_HZ, TURN_S, TURNS = 300, 5.0, 8
READING, SLOW = 4, 1
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9}
_FEWEST_UPDATES_HZ = 10.0


def run() -> list[Table]:
    """Measure latencies with and without clients."""
    camera = ["--frame-rate-hz", str(RATE_HZ), "--rows-per-block", "4"]
    engine = ["--images-every", "30"]
    with engine_and_camera({**SMALL, **USUAL}, camera, engine) as processes:
        processes.until_processed(3 * RATE_HZ)
        with page(processes.name) as (server, url):
            latencies, updates_hz = asyncio.run(_turns(processes.name, server, url))
    rows = []
    for name, percent in PERCENTILES.items():
        times: Times = {
            method: np.array([np.percentile(each, percent) for each in found])
            for method, found in latencies.items()
        }
        ratio = median_ratio(times, "watched", "alone")
        values = {method: float(np.median(each)) for method, each in times.items()} | {"ratio": ratio}
        known = {"ratio": spread(times, lambda each: median_ratio(each, "watched", "alone"))}
        rows.append(Row(name, values, spread=known))
    updates = Row(
        "updates of each client that reads",
        {"per second": updates_hz},
        f">= {_FEWEST_UPDATES_HZ:g}",
        updates_hz >= _FEWEST_UPDATES_HZ,
    )
    note = (
        f"{TURNS} turns of {TURN_S:g} s each at {RATE_HZ} frames/s, {READING} clients that read and {SLOW} "
        "that does not; medians of the turns, us, and the median of their ratios"
    )
    return [
        Table("live", "From the last row to the slopes, page watched and not there, us", rows, [note]),
        Table("live-updates", "What the page's clients get", [updates]),
    ]


async def _turns(
    name: str, server: subprocess.Popen[str], url: str
) -> tuple[dict[str, list[NDArray[np.float64]]], float]:
    """Return latencies (us) of every turn by method, and how often a client was told of new frames."""
    reader = TelemetryRing.attach(name)
    clients = [await client(url) for _ in range(READING + SLOW)]
    counts = [0] * READING
    reading = [asyncio.ensure_future(read(each, counts, i)) for i, each in enumerate(clients[:READING])]
    found: dict[str, list[NDArray[np.float64]]] = {"alone": [], "watched": []}
    watched_s, updates = 0.0, 0
    for turn in range(2 * TURNS):
        method = "watched" if turn % 2 else "alone"
        os.kill(server.pid, signal.SIGCONT if method == "watched" else signal.SIGSTOP)
        await asyncio.sleep(0.5)  # the page takes up what it missed
        before, cursor = sum(counts), reader.records.written
        await asyncio.sleep(TURN_S)
        records, _, _ = reader.records.since(cursor)
        found[method].append((records["published_time_ns"] - records["last_row_time_ns"]) / 1e3)
        if method == "watched":
            watched_s += TURN_S
            updates += sum(counts) - before
    for task in reading:
        task.cancel()
    for each in clients:
        each.close()
    reader.close()
    return found, updates / READING / watched_s


async def client(url: str) -> WebSocketClientConnection:
    """Open a web socket as the page does; one that is not read takes no more than one message."""
    host = urlsplit(url).netloc
    request = HTTPRequest(f"ws://{host}/stream", headers={"Origin": f"http://{host}"})
    opened = await websocket_connect(request, max_message_size=1 << 26)
    await opened.write_message(json.dumps({"do": "hello"}))
    return opened


async def read(connection: WebSocketClientConnection, counts: list[int], place: int) -> None:
    """Read for ever, and count the messages that say what the newest frame is."""
    while (message := await connection.read_message()) is not None:
        counts[place] += isinstance(message, bytes) and b'"kind": "now"' in message[:40]


@contextmanager
def page(name: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Serve the page of an engine; return its process and address."""
    command = [sys.executable, "-m", "faintspot", "live", "--name", name, "--port", "0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        time.sleep(2.0)  # it has imported all that it needs
        yield server, url
    finally:
        server.send_signal(signal.SIGCONT)
        server.terminate()
        server.communicate()
