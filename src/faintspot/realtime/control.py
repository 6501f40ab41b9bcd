"""The control channel of a running engine: requests of the same user, over a Unix socket.

A request is one line of JSON, {"command": NAME, ...}; the reply is one line as well: {"ok": true, ...} or
{"ok": false, "error": "one line"}. A connection may carry several requests, one after the other.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.errors import InputError
from faintspot.realtime.private_socket import bound_listener, engine_name, lock_path, locked_beside, peer_uid

Handler = Callable[[dict[str, Any]], Mapping[str, Any]]
"""What a command does: takes the request without its command, returns what the reply says."""

LARGEST_REQUEST = 64 * 1024
_LARGEST_REPLY = 16 * 1024 * 1024
_MOST_CONNECTIONS = 64
_IDLE_S = 30.0  # a connection without a request, or that does not read its reply, for so long is closed
_PAUSE_S = 0.1  # where the system has no file descriptor left


def request(path: str | Path, command: str, /, *, timeout_s: float = 5.0, **fields: Any) -> dict[str, Any]:
    """Send a request to a running engine and return what it replies.

    Parameters
    ----------
    path : str or Path
        Its socket; see `socket_path`.
    command : str
    timeout_s : float
        How long to wait for the whole reply.
    **fields
        What else the request says: anything that JSON can hold.

    Raises
    ------
    InputError
        When no engine listens there, when it says no, and when it does not answer in time.
    """
    name = engine_name(Path(path))
    try:
        line = _encoded({"command": command, **fields})
    except (TypeError, ValueError) as error:
        raise InputError(f"request: expected what JSON can hold ({error})") from None
    if len(line) > LARGEST_REQUEST:
        raise InputError(f"request: expected at most {LARGEST_REQUEST} bytes, got {len(line)}")
    end = time.monotonic() + timeout_s
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            _connect(connection, Path(path), end)
            if peer_uid(connection) != os.geteuid():
                raise InputError(f"the engine {name} belongs to another user")
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it may say why
                connection.sendall(line)
            reply = _received_line(connection, end)
        except TimeoutError:
            raise InputError(f"the engine {name} does not answer: waited {timeout_s:g} s") from None
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            raise InputError(
                f"no engine runs under the name {name}; faintspot realtime run starts one"
            ) from None
        except PermissionError:
            raise InputError(f"the engine {name} belongs to another user") from None
        except OSError as error:
            raise InputError(f"the engine {name} cannot be reached: {error.strerror or error}") from None
    return _checked_reply(name, reply)


class ControlServer:
    """Answers requests in a thread of its own, until it is closed.

    Clients that hang, send garbage or go away neither stop it nor hold up others: nothing that it does waits
    for one of them. Commands are carried out one after the other; one that takes long holds up the next.
    Every process but those of the same user is told no.

    Parameters
    ----------
    path : str or Path
        Its socket; see `socket_path`. Beside it lies a lock file, which tells a living server from the
        remains of a dead one.
    handlers : mapping of str to function
        What each command does. An exception becomes the reply's error.

    Raises
    ------
    InputError
        When another server lives there, or the place is not private.
    """

    def __init__(self, path: str | Path, handlers: Mapping[str, Handler]) -> None:
        self.path = Path(path)
        self._handlers = dict(handlers)
        self._uid = os.geteuid()
        self._closing = False
        self._connections: list[_Connection] = []
        self._lock_file = locked_beside(self.path)
        try:
            self._listener = bound_listener(self.path)
        except BaseException:
            os.close(self._lock_file)
            raise
        self._inode = os.stat(self.path).st_ino
        self._waker, self._wake = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="faintspot-control", daemon=True)
        self._thread.start()

    def __enter__(self) -> ControlServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop answering and remove the socket; closing again does nothing."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._waker.send(b".")
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _serve(self) -> None:
        """The thread: until it is told to close."""
        try:
            while not self._closing:
                waiting = any(connection.can_answer for connection in self._connections)
                patience = 0.0 if waiting else _IDLE_S / 4 if self._connections else None
                for key, _ in self._selector.select(patience):
                    if key.fileobj is self._listener:
                        self._accept()
                    elif isinstance(key.data, _Connection):
                        self._attempt(key.data, key.data.transfer)
                for connection in list(self._connections):
                    # One request of each in turn, so that nobody who sends many holds up the others.
                    self._attempt(connection, partial(connection.answer, self._reply))
                now = time.monotonic()
                for connection in [each for each in self._connections if now - each.active > _IDLE_S]:
                    self._drop(connection)
        finally:
            self._release()

    def _accept(self) -> None:
        try:
            accepted, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # no file descriptor left, mostly: make room
            if self._connections:
                self._drop(min(self._connections, key=lambda each: each.active))
            time.sleep(_PAUSE_S)
            return
        accepted.setblocking(False)
        if peer_uid(accepted) != self._uid:
            with contextlib.suppress(OSError):
                accepted.send(_encoded(_refusal("this engine answers only the user that runs it")))
            accepted.close()
            return
        if len(self._connections) >= _MOST_CONNECTIONS:
            self._drop(min(self._connections, key=lambda each: each.active))
        self._connections.append(_Connection(accepted, self._selector))

    def _attempt(self, connection: _Connection, action: Callable[[], None]) -> None:
        """Do something with a connection; close it where it is over."""
        try:
            if connection in self._connections:  # not closed meanwhile, to make room
                action()
        except OSError:
            connection.over = True
        if connection.over:
            self._drop(connection)

    def _drop(self, connection: _Connection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            connection.close()

    def _reply(self, line: bytes) -> bytes:
        """Carry out one request; whatever happens, there is a reply."""
        try:
            fields = _parsed_request(line)
            command = fields.pop("command", None)
            if not isinstance(command, str) or command not in self._handlers:
                known = ", ".join(sorted(self._handlers))
                raise InputError(f"command = {command!r:.80}: expected one of {known}")
            reply = _encoded({"ok": True, **self._handlers[command](fields)})
            if len(reply) > _LARGEST_REPLY:
                raise InputError(f"reply: expected at most {_LARGEST_REPLY} bytes, got {len(reply)}")
            return reply
        except InputError as error:
            return _encoded(_refusal(str(error)))
        except Exception as error:  # a fault of a command must not end the channel
            return _encoded(_refusal(f"{type(error).__name__}: {error}"))

    def _release(self) -> None:
        """Give back everything; the socket file only where it is still this server's."""
        for connection in list(self._connections):
            self._drop(connection)
        self._selector.close()
        with contextlib.suppress(OSError):
            if os.stat(self.path).st_ino == self._inode:
                os.unlink(self.path)
                os.unlink(lock_path(self.path))
        for end in (self._listener, self._wake, self._waker):
            end.close()
        os.close(self._lock_file)


class _Connection:
    """One client: what it has sent so far, and what it has not read yet."""

    def __init__(self, connection: socket.socket, selector: selectors.BaseSelector) -> None:
        self._socket, self._selector = connection, selector
        self._inbox, self._outbox = bytearray(), memoryview(b"")
        self._finished = False  # no more requests; to be closed when the reply is gone
        self.over = False
        self.active = time.monotonic()
        self._selector.register(connection, selectors.EVENT_READ, self)

    @property
    def can_answer(self) -> bool:
        """Whether there is a request to carry out now; none before the reply to the last one is gone."""
        return not self._outbox and not self.over and b"\n" in self._inbox

    def transfer(self) -> None:
        """Send or receive what can be without waiting."""
        if self._outbox:
            self._send()
        elif not self.can_answer:  # else first that request: at most one more fits beside it
            self._receive()

    def answer(self, reply: Callable[[bytes], bytes]) -> None:
        """Carry out the next request, if there is one."""
        if not self.can_answer:
            return
        line, _, rest = bytes(self._inbox).partition(b"\n")
        self._inbox = bytearray(rest)
        if len(line) >= LARGEST_REQUEST:
            self._refuse_size()
        else:
            self._outbox = memoryview(reply(line))
        self.active = time.monotonic()
        self._send()

    def close(self) -> None:
        """Close it."""
        self._selector.unregister(self._socket)
        self._socket.close()

    def _receive(self) -> None:
        try:
            data = self._socket.recv(LARGEST_REQUEST)
        except BlockingIOError:
            return
        self._inbox += data
        if not data:
            # Requests that came before the end are still answered; what has no line's end is none.
            self._finished = True
        elif b"\n" not in self._inbox and len(self._inbox) >= LARGEST_REQUEST:
            self._refuse_size()
            self._send()
        self._watch()

    def _refuse_size(self) -> None:
        text = f"request: expected at most {LARGEST_REQUEST} bytes in one line"
        self._outbox = memoryview(_encoded(_refusal(text)))
        self._inbox.clear()
        self._finished = True

    def _send(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._outbox = self._outbox[self._socket.send(self._outbox) :]
        self._watch()

    def _watch(self) -> None:
        """Choose what to wait for next."""
        self.over = self._finished and not self._outbox and not self.can_answer
        events = selectors.EVENT_WRITE if self._outbox else selectors.EVENT_READ
        self._selector.modify(self._socket, events, self)


# Messages -------------------------------------------------------------------------------------------


def _encoded(message: Mapping[str, Any]) -> bytes:
    return json.dumps(message, allow_nan=False, default=_jsonable).encode() + b"\n"


def _jsonable(value: Any) -> Any:
    """What JSON does not know: NumPy's numbers and arrays, paths."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _refusal(text: str) -> dict[str, Any]:
    return {"ok": False, "error": " ".join(text.split())[:2000]}


def _parsed_request(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line.decode())
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise InputError(f"request: expected a JSON object in one line, got {line[:40]!r}")
    return message


# The client -----------------------------------------------------------------------------------------


def _connect(connection: socket.socket, path: Path, end: float) -> None:
    while True:
        _set_timeout(connection, end)
        try:
            return connection.connect(os.fspath(path))
        except BlockingIOError:  # many others connect at this moment
            time.sleep(0.01)


def _received_line(connection: socket.socket, end: float) -> bytes:
    """What comes until a line's end, or until the other end closes."""
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


def _checked_reply(name: str, line: bytes) -> dict[str, Any]:
    if not line.endswith(b"\n"):
        raise InputError(f"the engine {name} went away before it had answered")
    try:
        reply = json.loads(line)
    except ValueError:
        reply = None
    if not isinstance(reply, dict) or not isinstance(reply.get("ok"), bool):
        raise InputError(f"the engine {name} replied what is not understood: {line[:40]!r}")
    if not reply.pop("ok"):
        raise InputError(str(reply.get("error", "refused without a reason")))
    return reply
