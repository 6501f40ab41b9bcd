"""Serving the page of an engine or a recording."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faintspot.live_page.access import Access
from faintspot.live_page.client_requests import EngineRequests
from faintspot.live_page.engine_source import EngineSource
from faintspot.live_page.recording_source import RecordingSource
from faintspot.live_page.server import LiveServer
from faintspot.live_page.status import StatusPoller
from faintspot.realtime.camera import StopEvent

PORT = 8642


def serve_engine(
    name: str,
    stop: StopEvent,
    ready: Callable[[LiveServer], None],
    *,
    address: str = "127.0.0.1",
    port: int = PORT,
    private: bool = False,
    folder: str | Path = ".",
) -> None:
    """Serve the page of a running engine until `stop` is set.

    Parameters
    ----------
    name : str
        Name of the engine, which may start later and restart.
    stop : event
    ready : function
        Called when the server is ready.
    address : str
        Address to bind to; other than this machine's own (127.0.0.1), reading needs the token, too.
    port : int
        Port; 0: any free one.
    private : bool
        Whether reading needs the token even on this machine.
    folder : path
        Folder for recordings started from the page.

    Raises
    ------
    InputError
        When the address is not valid, or cannot be bound.
    MissingExtraError
        When tornado or pyshmem is not installed.
    """

    async def work() -> None:
        source, client_requests = EngineSource(name), EngineRequests(name, folder)
        server = LiveServer(source, client_requests, Access(address, private), address, port)

        def told(kind: str, values: dict[str, Any]) -> None:
            server.tell(
                kind,
                {**values, "recording": client_requests.recording.status()} if kind == "status" else values,
            )

        poller = StatusPoller(name, told)
        try:
            ready(server)
            await server.run(stop)
        finally:
            poller.close()
            client_requests.close()
            source.close()

    asyncio.run(work())


def serve_recording(
    path: str | Path,
    stop: StopEvent,
    ready: Callable[[LiveServer], None],
    *,
    address: str = "127.0.0.1",
    port: int = PORT,
    private: bool = False,
) -> None:
    """Serve the page of a recording until `stop` is set; see `serve_engine`.

    Raises
    ------
    InputError
        When the file is not a recording, or the address as for `serve_engine`.
    """

    async def work() -> None:
        source = RecordingSource(path)
        server = LiveServer(source, source, Access(address, private), address, port)
        ready(server)
        await server.run(stop)

    asyncio.run(work())
