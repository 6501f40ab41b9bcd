"""The page's server: a few files of the package, and a web socket."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import partial
from importlib.resources import files
from pathlib import Path

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.text_files import parse_json, to_json
from faintspot.engine.page.client_requests import Access, EngineRequests, answered
from faintspot.engine.page.engine_source import EngineSource
from faintspot.engine.page.page import UPDATE_S, LatestMessages, Page, StatusPoller, packed
from faintspot.engine.page.page_state import BatchSource
from faintspot.engine.processes.requests import Handler

try:
    from tornado.httpserver import HTTPServer
    from tornado.web import Application, HTTPError, RequestHandler
    from tornado.websocket import WebSocketClosedError, WebSocketHandler
except ImportError:
    raise MissingExtraError("tornado", "realtime", "The live page") from None

LARGEST_REQUEST = 16 * 1024
MOST_CLIENTS = 32
_HELLO_S = 10.0  # time limit for a client's first message
_SLOW_S = 30.0  # time limit for a client to receive one message
_REST_S = 0.02  # pause between two updates, in addition to their duration
_PAUSE_S = 0.05  # pause between two requests of one client
_WRONG_TOKEN_S = 0.5
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_LOG_INTERVAL_S = 60.0
_GARBAGE, _TOO_SLOW, _NOT_ALLOWED = 1008, 1013, 1008  # close codes of web sockets


class LiveServer:
    """Server of a source's page in the running event loop.

    Parameters
    ----------
    source : BatchSource
    client_requests : mapping
        Functions of the requests that clients may make, by name.
    access : Access
    address : str
    port : int
        Port; 0: any free one.

    Raises
    ------
    InputError
        When the address cannot be bound.
    """

    def __init__(
        self,
        source: BatchSource,
        client_requests: Mapping[str, Handler],
        access: Access,
        address: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        self.access, self.client_requests, self.latest_messages = access, client_requests, LatestMessages()
        self.clients: set[Client] = set()
        self._loop = asyncio.get_running_loop()
        self._page = Page(source, self._tell)
        self._looking = ThreadPoolExecutor(1, "faintspot-page")
        self.assets = _assets()
        try:
            family = socket.AF_INET6 if ":" in address else socket.AF_INET
            listening = socket.create_server((address, port), family=family)
        except OSError as error:
            raise InputError(
                f"{address}:{port}: cannot listen there ({error.strerror}); choose another --port"
            ) from None
        listening.setblocking(False)
        self._address, self.port = address, int(listening.getsockname()[1])
        _limit_logging()
        self._http = HTTPServer(
            Application(
                [(r"/stream", Client, {"server": self}), (r"/([a-z_.]*)", Asset, {"server": self})],
                log_function=lambda handler: None,
                websocket_max_message_size=LARGEST_REQUEST,
                websocket_ping_interval=20,
            ),
            max_header_size=LARGEST_REQUEST,
            max_body_size=LARGEST_REQUEST,
            idle_connection_timeout=_SLOW_S,
        )
        self._http.add_sockets([listening])

    @property
    def url(self) -> str:
        """The page's address, with the token that permits changes."""
        host = f"[{self._address}]" if ":" in self._address else self._address
        return f"http://{host}:{self.port}/#{self.access.token}"

    async def run(self, stop: threading.Event) -> None:
        """Update the page and serve it until the event is set."""
        try:
            while not stop.is_set():
                next_s = self._loop.time() + UPDATE_S
                await self._loop.run_in_executor(self._looking, self._page.step)
                await asyncio.sleep(max(_REST_S, next_s - self._loop.time()))
        finally:
            self._http.stop()
            for client in list(self.clients):
                client.close()
            await self._http.close_all_connections()
            self._looking.shutdown()

    def tell(self, kind: str, values: Mapping[str, object]) -> None:
        """Set the message of a kind, from any thread."""
        self._tell(kind, packed(kind, values))

    def _tell(self, kind: str, message: bytes | None) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop may have ended
            if message is None:
                self._loop.call_soon_threadsafe(self.latest_messages.forget, kind)
            else:
                self._loop.call_soon_threadsafe(self.latest_messages.post, kind, message)


class _RateLimit(logging.Filter):
    """Filter for one record per `_LOG_INTERVAL_S`, with the number of records left out since the last."""

    _next_s, _left_out = 0.0, 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            self._left_out += 1
            return False
        if self._left_out:
            record.msg, record.args = f"{record.getMessage()} ({self._left_out} more left out)", ()
        self._next_s, self._left_out = now_s + _LOG_INTERVAL_S, 0
        return True


_rate_limit = _RateLimit()


def _limit_logging() -> None:
    """Keep clients from filling the log: drop records of their errors, limit those of the server's."""
    for name in ("tornado.access", "tornado.general"):
        logging.getLogger(name).addHandler(logging.NullHandler())
    for name in ("tornado.application", "asyncio"):
        logging.getLogger(name).addFilter(_rate_limit)


def _assets() -> dict[str, tuple[str, bytes]]:
    """Return the page's files by name, with their types; the page itself is ""."""
    contents = {}
    for item in files("faintspot.engine.page").joinpath("assets").iterdir():
        kind = _TYPES.get(item.name.rpartition(".")[2])
        if kind is not None:
            contents["" if item.name == "index.html" else item.name] = kind, item.read_bytes()
    return contents


class _Guarded(RequestHandler):
    """Handler that refuses requests with a foreign Host header."""

    def initialize(self, server: LiveServer) -> None:
        """Store the server; called by tornado."""
        self.server = server

    def prepare(self) -> None:
        """Refuse a foreign Host header."""
        if not self.server.access.permits_host(self.request.headers.get("Host")):
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        """Restrict the page to its own files by security headers."""
        for name, value in _HEADERS.items():
            self.set_header(name, value)
        self.clear_header("Server")

    def write_error(self, status_code: int, **_: object) -> None:
        """Send the status code only."""
        self.set_header("Content-Type", "text/plain")
        self.finish(f"{status_code}\n")


class Asset(_Guarded):
    """Handler of the page's files."""

    def get(self, name: str) -> None:
        """Send the file."""
        if name not in self.server.assets:
            raise HTTPError(404)
        kind, content = self.server.assets[name]
        self.set_header("Content-Type", f"{kind}; charset=utf-8")
        self.finish(content)


class Client(_Guarded, WebSocketHandler):
    """An open page: identifies itself, receives updates and makes requests one after another."""

    _feeding: asyncio.Task[None] | None = None
    _may_change = False

    def prepare(self) -> None:
        """Refuse foreign pages, and more clients than the limit."""
        super().prepare()
        if not self.server.access.permits_origin(self.request.headers):
            raise HTTPError(403)
        if len(self.server.clients) >= MOST_CLIENTS:
            raise HTTPError(503)

    def check_origin(self, origin: str) -> bool:
        """Return True: `prepare` has checked the origin more strictly than tornado does."""
        return True

    def open(self, *_: str, **__: str) -> None:
        """Give the client time to identify itself."""
        self.server.clients.add(self)
        self._too_late = asyncio.get_running_loop().call_later(_HELLO_S, self.close, _NOT_ALLOWED)

    def on_close(self) -> None:
        """Stop sending updates."""
        self.server.clients.discard(self)
        self._too_late.cancel()
        if self._feeding is not None:
            self._feeding.cancel()

    async def on_message(self, message: str | bytes) -> None:
        """Answer a request; the next one is read afterwards."""
        try:
            request = _parsed(message)
        except InputError as error:
            self.close(_GARBAGE, str(error)[:100])
            return
        number = request.pop("id", None)
        if self._feeding is None or request.get("do") == "hello":
            reply = await self._greeted(request)
        elif not self._may_change:
            reply = {"ok": False, "error": "read-only: changes need the token that was printed at the start"}
        else:
            # In a thread, because the engine may take long to answer.
            reply = await _in_thread(partial(answered, self.server.client_requests, request))
        with contextlib.suppress(WebSocketClosedError):
            await self.write_message(to_json({"id": number, **reply}))
        if self._feeding is None:
            self.close(_NOT_ALLOWED)
        await asyncio.sleep(_PAUSE_S)

    async def _greeted(self, request: Mapping[str, object]) -> dict[str, object]:
        """Admit a client with the rights of its token."""
        token, access = request.get("token"), self.server.access
        is_known = request.get("do") == "hello" and access.knows(token)
        if not is_known and (token or access.reading_needs_token):
            await asyncio.sleep(_WRONG_TOKEN_S)
            if access.reading_needs_token:
                return {"ok": False, "error": "this page needs the token that was printed at the start"}
        self._may_change = self._may_change or is_known
        if self._feeding is None:
            self._too_late.cancel()
            self._feeding = asyncio.get_running_loop().create_task(self._feed())
        if token and not is_known:
            return {"ok": False, "error": "wrong token, expected the one that was printed at the start"}
        return {"ok": True, "may_change": self._may_change}

    async def _feed(self) -> None:
        """Send the newest messages one after another; messages missed by a slow client are skipped."""
        last = 0
        with contextlib.suppress(WebSocketClosedError):
            while True:
                number, message = (await self.server.latest_messages.newer(last))[0]
                try:
                    await asyncio.wait_for(self.write_message(message, binary=True), _SLOW_S)
                except TimeoutError:
                    self.close(_TOO_SLOW)
                    return
                last = number


def _parsed(message: str | bytes) -> dict[str, object]:
    """Return a request: a JSON object with "do", whose values can be sent back as JSON."""
    try:
        request = parse_json(message) if isinstance(message, str) else None
        json.dumps(request, ensure_ascii=False, allow_nan=False).encode()  # lone surrogates, -1e999
    except (ValueError, RecursionError):
        request = None
    if not isinstance(request, dict) or not isinstance(request.get("do"), str):
        raise InputError('expected a JSON object with "do"')
    return request


async def _in_thread(work: Callable[[], dict[str, object]]) -> dict[str, object]:
    """Run a function in a daemon thread and wait for its result."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[dict[str, object]] = loop.create_future()

    def finish(reply: dict[str, object]) -> None:
        if not done.done():  # else the caller was cancelled
            done.set_result(reply)

    def run() -> None:
        reply = work()
        with contextlib.suppress(RuntimeError):  # the server may have closed
            loop.call_soon_threadsafe(finish, reply)

    threading.Thread(target=run, name="faintspot-command", daemon=True).start()
    return await done


def serve(
    name: str,
    stop: threading.Event,
    ready: Callable[[LiveServer], None],
    *,
    address: str = "127.0.0.1",
    port: int = 8642,
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
        When the address is not valid or cannot be bound.
    MissingExtraError
        When tornado or pyshmem is not installed.
    """

    async def work(used: ExitStack) -> None:
        access = Access(address, private)
        source = used.enter_context(closing(EngineSource(name)))
        requests = used.enter_context(closing(EngineRequests(name, folder)))
        server = LiveServer(source, requests.functions(), access, address, port)

        def send(kind: str, values: dict[str, object]) -> None:
            recording = {"recording": requests.recording.status()} if kind == "status" else {}
            server.tell(kind, values | recording)

        used.enter_context(closing(StatusPoller(name, send)))
        ready(server)
        await server.run(stop)

    with ExitStack() as used:
        asyncio.run(work(used))
