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


class Refused(Exception):
    """The server does not take this client: the status is its argument."""


class Client:
    """A web socket by hand: what comes is taken from the socket only when the test reads."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self.close_code: int | None = None

    async def send(self, message: str | bytes) -> None:
        binary = isinstance(message, bytes)
        data = message if isinstance(message, bytes) else message.encode("utf-8", "surrogatepass")
        size = len(data)
        length = bytes([0x80 | size]) if size < 126 else b"\xfe" + size.to_bytes(2)
        self._writer.write(bytes([0x82 if binary else 0x81]) + length + bytes(4) + data)  # masked with zeros
        await self._writer.drain()

    async def read(self) -> str | bytes | None:
        """Return the next message, None when the server has closed."""
        while True:
            try:
                kind, size = await self._reader.readexactly(2)
                if size >= 126:
                    size = int.from_bytes(await self._reader.readexactly(2 if size == 126 else 8))
                data = await self._reader.readexactly(size)
            except (asyncio.IncompleteReadError, ConnectionError):
                self.close_code = 1006
                return None
            if kind == 0x88:
                self.close_code = int.from_bytes(data[:2])
                self.close()
                return None
            if kind in (0x81, 0x82):
                return data.decode() if kind == 0x81 else data

    def close(self) -> None:
        """Be gone, as a client that has died."""
        self._writer.close()


def next_batch(source: BatchSource) -> Batch:
    """What a source has read since it was asked before."""
    batch = source.read()
    assert batch is not None
    return batch


async def connected(server: LiveServer, **headers: str) -> Client:
    """Open a web socket as the page's own script does, but for these headers; "": without it."""
    host = f"127.0.0.1:{server.port}"
    sent = {
        "Host": host,
        "Origin": f"http://{host}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Version": "13",
    } | headers
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=4096)
    client = Client(reader, writer)
    _opened.append(client)
    lines = "".join(f"{name}: {value}\r\n" for name, value in sent.items() if value)
    writer.write(f"GET /stream HTTP/1.1\r\n{lines}\r\n".encode())
    status = int((await reader.readline()).split()[1])
    if status != 101:
        raise Refused(status)
    await reader.readuntil(b"\r\n\r\n")
    return client


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
