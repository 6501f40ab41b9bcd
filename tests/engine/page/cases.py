"""A source that the tests play, a server of it, and its clients."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from faintspot.engine.page.client_requests import Access
from faintspot.engine.page.page_state import Batch, BatchSource, Picture
from faintspot.engine.page.server import LiveServer
from faintspot.engine.processes.requests import Handler
from faintspot.engine.telemetry.ring import record_type
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((3, 3), pixels=8, inner_radius=0.5)
N = len(LAYOUT)
PATIENCE_S = 20.0
_opened: list[Client] = []


def records(first: int, count: int, *, method: int = 0, interval_s: float = 0.01) -> NDArray[Any]:
    """Records of `count` frames from number `first` on, valid, 100 e-, 50 us late."""
    made = np.zeros(count, record_type(N))
    made["frame"] = np.arange(first, first + count)
    made["method"] = method
    made["last_row_time_ns"] = 1e9 * interval_s * made["frame"]
    made["published_time_ns"] = made["last_row_time_ns"] + 50_000
    made["flux"] = 100.0
    made["x"] = (made["frame"] % 2 - 0.5)[:, None]
    return made


class Played:
    """Gives a frame, with its picture, each time it is asked."""

    def __init__(self, layout: Layout = LAYOUT) -> None:
        self.name, self.methods, self.frames = "played", ["set"], 0
        self.layout: Layout | None = layout

    def read(self) -> Batch | None:
        assert self.layout is not None
        if self.layout is not LAYOUT:
            raw = np.random.default_rng(self.frames).normal(size=self.layout.frame_shape).astype(np.float32)
        else:
            raw = np.full(LAYOUT.frame_shape, self.frames, np.float32)
        denoised = np.zeros((len(self.layout), *self.layout.window), np.float32)
        picture = Picture(self.frames, raw, denoised)
        made = records(self.frames, 1) if self.layout is LAYOUT else np.empty(0, record_type(N))
        self.frames += 1
        return Batch(made, picture=picture, anew=self.frames == 1)

    def state(self) -> dict[str, Any]:
        return {"kind": "engine", "name": self.name, "there": True}


class Noted(dict[str, Handler]):
    """Notes what clients wish."""

    def __init__(self) -> None:
        super().__init__(set=self._note)
        self.asked: list[dict[str, Any]] = []

    def _note(self, asked: dict[str, Any]) -> Mapping[str, Any]:
        self.asked.append(asked)
        return {"text": "noted"}


def served(
    check: Callable[[LiveServer], Awaitable[None]],
    source: BatchSource | None = None,
    address: str = "127.0.0.1",
) -> LiveServer:
    """Serve a source while the check runs; return the server with what it noted."""

    async def work() -> LiveServer:
        server = LiveServer(source or Played(), Noted(), Access(address), address)
        stop = threading.Event()
        running = asyncio.get_running_loop().create_task(server.run(stop))
        try:
            await asyncio.wait_for(check(server), PATIENCE_S)
        finally:
            while _opened:
                _opened.pop().close()
            stop.set()
            await running
            while _opened:
                _opened.pop().close()
            await asyncio.sleep(0.01)  # so that they notice
        return server

    return asyncio.run(work())


class Client:
    """A web socket."""

    def __init__(self, connection: WebSocketClientConnection) -> None:
        assert connection.protocol is not None
        assert connection.protocol.stream is not None
        self._connection, self._stream = connection, connection.protocol.stream
        _opened.append(self)

    async def send(self, message: str | bytes) -> None:
        await self._connection.write_message(message, binary=isinstance(message, bytes))

    async def read(self) -> str | bytes | None:
        """Return the next message, None when the server has closed."""
        return await self._connection.read_message()

    @property
    def close_code(self) -> int:
        return self._connection.close_code or 1006

    def close(self) -> None:
        """Be gone, as a client that has died."""
        self._connection.close()
        self._stream.close()  # without waiting for the server


def next_batch(source: BatchSource) -> Batch:
    """What a source has read since it was asked before."""
    batch = source.read()
    assert batch is not None
    return batch


async def connected(server: LiveServer, **headers: str) -> Client:
    """Open a web socket as the page's own script does, but for these headers; "": without it."""
    host = f"127.0.0.1:{server.port}"
    sent = {"Host": host, "Origin": f"http://{host}"} | headers
    present = {name: value for name, value in sent.items() if value or name == "Host"}
    return Client(await websocket_connect(HTTPRequest(f"ws://{host}/stream", headers=present)))


async def asked(client: Client, **request: Any) -> dict[str, Any]:
    """Send a request; return its answer, whatever else comes before."""
    await client.send(json.dumps({"id": 7, **request}))
    while True:
        message = await client.read()
        assert message is not None, f"closed: {client.close_code}"
        if isinstance(message, str):
            answer: dict[str, Any] = json.loads(message)
            assert answer["id"] == 7
            return answer


def unpacked(message: bytes) -> tuple[str, dict[str, Any], dict[str, NDArray[Any]]]:
    """Kind, values and arrays of a message, read as the page's script does."""
    (length,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + length])
    arrays = {}
    for name, (kind, shape, offset) in head["arrays"].items():
        assert (4 + length + offset) % 8 == 0
        count = int(np.prod(shape, dtype=int))
        arrays[name] = np.frombuffer(message, kind, count, 4 + length + offset).reshape(shape)
    return head["kind"], head["values"], arrays


async def next_of(client: Client, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Wait for a message of a kind."""
    while True:
        message = await client.read()
        assert message is not None, f"closed: {client.close_code}"
        if isinstance(message, bytes):
            found, values, arrays = unpacked(message)
            if found == kind:
                return values, arrays
