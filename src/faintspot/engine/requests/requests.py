"""The control channel of a running engine: requests of the same user over a Unix socket.

A request is one line of JSON, {"command": NAME, ...}. The reply is one line too: {"ok": true, ...} or
{"ok": false, "error": "one line"}. A connection may carry several requests in sequence.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.base.json_text import parse_json, to_json
from faintspot.engine.requests.private_socket import (
    ENGINE,
    bound_listener,
    lock_path,
    locked_beside,
    peer_uid,
    server_of,
)

Handler = Callable[[dict[str, Any]], Mapping[str, Any]]
"""Function of a command: takes the fields of the request, returns the fields of the reply."""

Result = TypeVar("Result")

LARGEST_REQUEST = 64 * 1024
LENGTHY_TIMEOUT_S = 180.0
"""Time that a client waits for a command that prepares something new and may compile [s]."""
EFFECT_TIMEOUT_S = 0.5
"""Time that a server waits for a change to take effect; then it replies that no frame came [s]."""
_LARGEST_REPLY = 16 * 1024 * 1024
_MOST_CONNECTIONS = 64
_IDLE_S = 30.0  # idle time after which a connection is closed
_PAUSE_S = 0.1  # when the system has no file descriptor left


def request(path: str | Path, command: str, /, *, timeout_s: float = 5.0, **fields: Any) -> dict[str, Any]:
    """Send a request to a running engine and return its reply.

    Parameters
    ----------
    path : str or Path
        Socket of the engine; see `socket_path`.
    command : str
    timeout_s : float
        Time to wait for the whole reply.
    **fields
        Other fields of the request, as JSON values.

    Raises
    ------
    InputError
        When no engine listens there, the engine refuses, or it does not answer in time.
    """
    kind, name = server_of(Path(path))
    starts = "run" if kind == ENGINE else f"{kind} run"
    try:
        line = _encoded({"command": command, **fields}, exact=True)
    except (TypeError, ValueError) as error:
        raise InputError(f"request: expected what JSON can hold ({error})") from None
    if len(line) > LARGEST_REQUEST:
        raise InputError(f"request: expected at most {LARGEST_REQUEST} bytes, got {len(line)}")
    end = time.monotonic() + timeout_s
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            _connect(connection, Path(path), end)
            if peer_uid(connection) != os.geteuid():
                raise InputError(f"the {kind} {name} belongs to another user")
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # its reply may hold the reason
                connection.sendall(line)
            reply = _received_line(connection, end)
        except TimeoutError:
            raise InputError(f"the {kind} {name} does not answer: waited {timeout_s:g} s") from None
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            raise InputError(
                f"no {kind} runs under the name {name}; faintspot realtime {starts} starts one"
            ) from None
        except PermissionError:
            raise InputError(f"the {kind} {name} belongs to another user") from None
        except OSError as error:
            raise InputError(f"the {kind} {name} cannot be reached: {error.strerror or error}") from None
    return _checked_reply(f"{kind} {name}", reply)


def since(frame: int | None) -> str:
    """Describe from which frame on a change is in effect; None: none has come yet."""
    return "taken at the next frame" if frame is None else f"in effect from frame {frame}"


class ControlServer(Closing):
    """Server that answers requests in a separate thread until closed.

    Clients that hang, send garbage or disconnect neither stop the server nor delay others. Commands named in
    `lengthy` run one after another in a second thread; all others are answered meanwhile. Processes of other
    users are refused.

    Parameters
    ----------
    path : str or Path
        Socket; see `socket_path`. A lock file beside it shows whether a server is alive or has died.
    handlers : mapping of str to function
        Function of each command. An exception becomes the reply's error.
    lengthy : collection of str
        Commands that may take long.

    Raises
    ------
    InputError
        When another server is alive there, or the folder is not private.
    """

    def __init__(
        self, path: str | Path, handlers: Mapping[str, Handler], lengthy: Collection[str] = ()
    ) -> None:
        self.path = Path(path)
        self._handlers, self._lengthy = dict(handlers), frozenset(lengthy)
        self._connections: dict[asyncio.Task[None], None] = {}  # ordered by idle time, longest first
        self._lock_file = locked_beside(self.path)
        try:
            self._listener = bound_listener(self.path)
        except BaseException:
            os.close(self._lock_file)
            raise
        self._inode = os.stat(self.path).st_ino
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._one_at_a_time = asyncio.Lock()
        self._thread = threading.Thread(target=self._run, name="faintspot-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering and remove the socket; repeated calls do nothing."""
        with contextlib.suppress(RuntimeError):  # already closed
            self._loop.call_soon_threadsafe(self._closing.set)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        """Run the server thread until it is closed."""
        try:
            with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
                runner.run(self._serve())
        finally:
            with contextlib.suppress(OSError):  # remove the socket file only if it is still this server's
                if os.stat(self.path).st_ino == self._inode:
                    os.unlink(self.path)
                    os.unlink(lock_path(self.path))
            self._listener.close()
            os.close(self._lock_file)

    async def _serve(self) -> None:
        self._listen()
        await self._closing.wait()  # afterwards the runner cancels the connections

    def _listen(self) -> None:
        self._loop.add_reader(self._listener, self._accept)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # usually: no file descriptor left
            self._make_room()
            self._loop.remove_reader(self._listener)
            self._loop.call_later(_PAUSE_S, self._listen)
            return
        if len(self._connections) >= _MOST_CONNECTIONS:
            self._make_room()
        connection.setblocking(False)
        task = self._loop.create_task(self._converse(connection))
        self._connections[task] = None
        task.add_done_callback(partial(self._end, connection))

    def _make_room(self) -> None:
        """Close the connection that was idle longest."""
        if self._connections:
            task = next(iter(self._connections))
            del self._connections[task]
            task.cancel()

    def _end(self, connection: socket.socket, task: asyncio.Task[None]) -> None:
        self._connections.pop(task, None)
        connection.close()

    async def _converse(self, connection: socket.socket) -> None:
        """Answer the requests of one connection until it ends or is idle for too long."""
        # Not with asyncio's streams: each leaves a reference cycle, and collection is off while frames
        # come.
        task, inbox = asyncio.current_task(), bytearray()
        with contextlib.suppress(OSError, TimeoutError):
            try:
                if peer_uid(connection) != os.geteuid():
                    kind, _ = server_of(self.path)
                    raise InputError(f"this {kind} answers only the user that runs it")
                while line := await _next_line(connection, inbox):
                    await _send(connection, await self._reply(line))
                    if task in self._connections:  # move it to the end: least idle
                        self._connections[task] = self._connections.pop(task)
                    await asyncio.sleep(0)  # many requests of one client must not delay others
            except InputError as error:
                await _send(connection, _encoded(_refusal(str(error))))

    async def _reply(self, line: bytes) -> bytes:
        """Carry out one request; always return a reply."""
        try:
            fields = _parsed_request(line)
            command = fields.pop("command", None)
            if not isinstance(command, str) or command not in self._handlers:
                commands = ", ".join(sorted(self._handlers))
                raise InputError(f"command = {command!r:.80}: expected one of {commands}")
        except InputError as error:
            return _encoded(_refusal(str(error)))
        work = partial(_answer, self._handlers[command], fields)
        if command not in self._lengthy:
            return work()
        async with self._one_at_a_time:
            return await in_thread(work)


async def _next_line(connection: socket.socket, inbox: bytearray) -> bytes:
    """Wait for a complete line; return b"" when the connection ends, raise InputError when it is too long."""
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(_IDLE_S):
        while not (size := inbox.find(b"\n") + 1) and len(inbox) < LARGEST_REQUEST:
            data = await loop.sock_recv(connection, LARGEST_REQUEST)
            if not data:
                return b""
            inbox += data
    if not 0 < size <= LARGEST_REQUEST:
        raise InputError(f"request: expected at most {LARGEST_REQUEST} bytes in one line")
    line = bytes(inbox[:size])
    del inbox[:size]
    return line


async def _send(connection: socket.socket, reply: bytes) -> None:
    async with asyncio.timeout(_IDLE_S):
        await asyncio.get_running_loop().sock_sendall(connection, reply)


async def in_thread(work: Callable[[], Result]) -> Result:
    """Run a function in a daemon thread and wait for its result."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[Result] = loop.create_future()

    def finish(reply: Result) -> None:
        if not done.done():  # else the caller was cancelled
            done.set_result(reply)

    def run() -> None:
        reply = work()
        with contextlib.suppress(RuntimeError):  # the server may have closed
            loop.call_soon_threadsafe(finish, reply)

    threading.Thread(target=run, name="faintspot-command", daemon=True).start()
    return await done


# Messages -------------------------------------------------------------------------------------------


def _answer(handler: Handler, fields: dict[str, Any]) -> bytes:
    """Carry out a command; always return a reply."""
    try:
        reply = _encoded({"ok": True, **handler(fields)})
        if len(reply) > _LARGEST_REPLY:
            raise InputError(f"reply: expected at most {_LARGEST_REPLY} bytes, got {len(reply)}")
        return reply
    except InputError as error:
        return _encoded(_refusal(str(error)))
    except BaseException as error:  # a command's fault or exit must not end the channel
        return _encoded(_refusal(f"{type(error).__name__}: {error}"))


def _encoded(message: Mapping[str, Any], *, exact: bool = False) -> bytes:
    return to_json(message, exact=exact).encode() + b"\n"


def _refusal(text: str) -> dict[str, Any]:
    return {"ok": False, "error": " ".join(text.split())[:2000]}


def _parsed_request(line: bytes) -> dict[str, Any]:
    try:
        message = parse_json(line.decode())
    except ValueError:
        message = None
    if not isinstance(message, dict):
        raise InputError(f"request: expected a JSON object in one line, got {line[:40]!r}")
    return message


def changes_of(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the new values of a request, by name.

    Raises
    ------
    InputError
        When there are none.
    """
    changes = fields.get("changes")
    if not isinstance(changes, dict) or not changes:
        raise InputError("changes: expected values by name, got none")
    return changes


# The client -----------------------------------------------------------------------------------------


def _connect(connection: socket.socket, path: Path, end: float) -> None:
    while True:
        _set_timeout(connection, end)
        try:
            return connection.connect(os.fspath(path))
        except BlockingIOError:  # many others are connecting
            time.sleep(0.01)


def _received_line(connection: socket.socket, end: float) -> bytes:
    """Receive up to the end of a line, or until the connection closes."""
    received = bytearray()
    while len(received) <= _LARGEST_REPLY:
        _set_timeout(connection, end)
        data = connection.recv(1 << 20)
        received += data
        if not data or b"\n" in data:
            break
    return bytes(received)


def _set_timeout(connection: socket.socket, end: float) -> None:
    remaining = end - time.monotonic()
    if remaining <= 0:
        raise TimeoutError
    connection.settimeout(remaining)


def _checked_reply(server: str, line: bytes) -> dict[str, Any]:
    if not line.endswith(b"\n"):
        raise InputError(f"the {server} ended before it answered")
    try:
        reply = parse_json(line)
    except ValueError:
        reply = None
    if not isinstance(reply, dict) or not isinstance(reply.get("ok"), bool):
        raise InputError(f"the {server} sent a reply that is not valid: {line[:40]!r}")
    if not reply.pop("ok"):
        raise InputError(str(reply.get("error", "refused without a reason")))
    return reply
