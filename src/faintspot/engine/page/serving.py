"""Serving the page of an engine or a recording."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

from faintspot.engine.page.access import Access
from faintspot.engine.page.client_requests import EngineRequests
from faintspot.engine.page.engine_source import EngineSource
from faintspot.engine.page.recording_source import RecordingSource
from faintspot.engine.page.server import LiveServer
from faintspot.engine.page.status import StatusPoller
from faintspot.engine.pixels.readout import StopEvent


def serve(
    shown: str | Path,
    stop: StopEvent,
    ready: Callable[[LiveServer], None],
    *,
    address: str = "127.0.0.1",
    port: int = 8642,
    private: bool = False,
    folder: str | Path = ".",
) -> None:
    """Serve the page of a running engine, or of a recording, until `stop` is set.

    Parameters
    ----------
    shown : str or Path
        Name of the engine, which may start later and restart; or path of a recording.
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
        Folder for recordings started from the page of an engine.

    Raises
    ------
    InputError
        When the address is not valid or cannot be bound, or the path is not a recording.
    MissingExtraError
        When tornado or pyshmem is not installed.
    """

    async def work(used: ExitStack) -> None:
        access = Access(address, private)
        if isinstance(shown, Path):
            recording = RecordingSource(shown)
            server = LiveServer(recording, recording, access, address, port)
        else:
            source = used.enter_context(closing(EngineSource(shown)))
            requests = used.enter_context(closing(EngineRequests(shown, folder)))
            server = LiveServer(source, requests, access, address, port)

            def send(kind: str, values: dict[str, object]) -> None:
                recording = {"recording": requests.recording.status()} if kind == "status" else {}
                server.tell(kind, values | recording)

            used.enter_context(closing(StatusPoller(shown, send)))
        ready(server)
        await server.run(stop)

    with ExitStack() as used:
        asyncio.run(work(used))
