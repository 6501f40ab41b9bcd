"""The control channel of a running engine: requests of the same user over a Unix socket.

A connection carries one request, a line of JSON {"command": NAME, ...}, and its reply, {"ok": true, ...} or
{"ok": false, "error": "one line"}.
"""

import contextlib
import fcntl
import os
import re
import socket
import socketserver
import stat
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.base.files import Closing
from faintspot.base.text_files import parse_json, to_json

_BACKLOG = 64
_LONGEST_PATH = 107  # bytes; limit for Unix sockets on Linux
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_PREFIX, _SUFFIX = "faintspot-", ".sock"
ENGINE, TELESCOPE = "engine", "telescope"
_TELESCOPE_SUFFIX = f"+{TELESCOPE}"  # no name has a "+"


def socket_path(name: str, kind: str = ENGINE) -> Path:
    """Return the socket path of an engine or telescope, in a folder that only this user can open.

    $XDG_RUNTIME_DIR/faintspot-NAME.sock if that folder belongs to the user, else a path in a private folder
    that the server makes in the temporary directory.

    Raises
    ------
    InputError
        When the name contains anything but letters, digits, "_", "." and "-".
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(
            f'name = {name!r:.80}: expected up to 64 letters, digits, "_", "." or "-", '
            "the first a letter or digit"
        )
    folder = Path(tempfile.gettempdir()) / f"faintspot-{os.geteuid()}"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    # After a change of user the variable may still name the other user's folder.
    if runtime and os.path.isdir(runtime) and os.stat(runtime).st_uid == os.geteuid():
        folder = Path(runtime)
    kind_suffix = _TELESCOPE_SUFFIX if kind == TELESCOPE else ""
    return folder / f"{_PREFIX}{name}{kind_suffix}{_SUFFIX}"


def server_of(path: Path) -> tuple[str, str]:
    """Return the kind (engine or telescope) and name of a socket's server; other paths are their own name."""
    name = path.name
    if not (name.startswith(_PREFIX) and name.endswith(_SUFFIX)):
        return ENGINE, str(path)
    name = name[len(_PREFIX) : -len(_SUFFIX)]
    if name.endswith(_TELESCOPE_SUFFIX):
        return TELESCOPE, name.removesuffix(_TELESCOPE_SUFFIX)
    return ENGINE, name


def locked_beside(path: Path) -> int:
    """Make the folder, and lock the file beside the socket that marks a living server.

    Returns
    -------
    int
        Descriptor of the lock file; closing it, or the end of the process, releases the lock.

    Raises
    ------
    InputError
        When another server holds the lock, or the folder is not private.
    """
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise InputError(f"{path}: expected a socket's path of at most {_LONGEST_PATH} bytes")
    try:
        with contextlib.suppress(FileExistsError):
            path.parent.mkdir(mode=0o700)
        _check_private(path.parent)
        while True:
            lock_file = _locked(path)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock_file), os.stat(lock_path(path))):
                    return lock_file
            os.close(lock_file)  # a closing server removed it between opening and locking
    except OSError as error:
        raise InputError(f"{path}: cannot listen there: {error.strerror}") from None


def lock_path(path: Path) -> Path:
    """Return the lock file of a socket; only the holder of the lock may remove it."""
    return path.with_name(f"{path.name}.lock")


def _locked(path: Path) -> int:
    """Open and lock the lock file; the system releases the lock however the process ends."""
    lock_file = os.open(lock_path(path), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock_file)
        kind, name = server_of(path)
        article = "an" if kind == ENGINE else "a"
        raise InputError(f"{article} {kind} is already running under the name {name}") from None
    return lock_file


def _check_private(folder: Path) -> None:
    """Refuse a folder in which another user could replace the socket."""
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise InputError(f"{folder}: expected a folder of your own that nobody else may write to")


def bound_listener(path: Path) -> socket.socket:
    """Return the listening socket, replacing one that a dead server left. Call it with the lock held.

    Raises
    ------
    InputError
        When the path is not a socket, or none can be made.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if os.path.lexists(path):
            if not stat.S_ISSOCK(os.lstat(path).st_mode):
                raise InputError(f"{path}: expected a socket or nothing, got another kind of file")
            os.unlink(path)
        listener.bind(os.fspath(path))
        os.chmod(path, 0o600)  # before it listens: until then nobody can connect
        listener.listen(_BACKLOG)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(f"{path}: cannot listen there: {error.strerror}") from None
    except InputError:
        listener.close()
        raise
    return listener


def peer_uid(connection: socket.socket) -> int:
    """Return the user at the other end, as the kernel reports."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("iII"))
    return int(struct.unpack("iII", credentials)[1])


Handler = Callable[[dict[str, Any]], Mapping[str, Any]]
"""Function of a command: takes the fields of the request, returns the fields of the reply."""

LARGEST_REQUEST = 64 * 1024
LENGTHY_TIMEOUT_S = 180.0
"""Time that a client waits for a command that prepares something new and may compile [s]."""
EFFECT_TIMEOUT_S = 0.5
"""Time that a server waits for a change to take effect; then it replies that no frame came [s]."""
_LARGEST_REPLY = 16 * 1024 * 1024
_IDLE_S = 30.0  # idle time after which a connection is closed
_LOOK_S = 0.1  # between two looks whether it is to close


def request(path: str | Path, command: str, /, *, timeout_s: float = 5.0, **fields: object) -> dict[str, Any]:
    """Send a request to a running engine and return its reply.

    Parameters
    ----------
    path : str or Path
        Socket of the engine; see `socket_path`.
    command : str
    timeout_s : float
        Time to wait for the connection, and for the reply.
    **fields
        Other fields of the request, as JSON values.

    Raises
    ------
    InputError
        When no engine listens there, the engine refuses, or it does not answer in time.
    """
    kind, name = server_of(Path(path))
    starts = "run" if kind == ENGINE else kind
    try:
        line = _encoded({"command": command, **fields}, exact=True)
    except (TypeError, ValueError) as error:
        raise InputError(f"request: expected what JSON can hold ({error})") from None
    if len(line) > LARGEST_REQUEST:
        raise InputError(f"request: expected at most {LARGEST_REQUEST} bytes, got {len(line)}")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection, connection.makefile("rb") as stream:
        connection.settimeout(timeout_s)
        try:
            _connect(connection, Path(path), time.monotonic() + timeout_s)
            if peer_uid(connection) != os.geteuid():
                raise InputError(f"the {kind} {name} belongs to another user")
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # its reply may hold the reason
                connection.sendall(line)
            reply = stream.readline(_LARGEST_REPLY + 1)
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
    """Server that answers requests, each connection in a thread of its own, until closed.

    Clients that hang, send garbage or disconnect neither stop the server nor delay others. A command named in
    `lengthy` waits for the same one only; all others are answered meanwhile, one after another. Only the user
    can open the socket.

    Parameters
    ----------
    path : str or Path
        Socket; see `socket_path`. A lock file beside it shows whether a server is alive or has died.
    handlers : mapping of str to function
        Function of each command; it may change while the server runs. An exception becomes the reply's error.
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
        self._handlers, self._brief_one = handlers, threading.Lock()
        self._lengthy_ones = {command: threading.Lock() for command in lengthy}
        self._closing = False
        self._lock_file = locked_beside(self.path)
        try:
            self._listener = _Listener(self.path, self._reply)
        except BaseException:
            os.close(self._lock_file)
            raise
        self._inode = os.stat(self.path).st_ino
        self._thread = threading.Thread(target=self._run, name="faintspot-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering and remove the socket; repeated calls do nothing."""
        self._closing = True
        self._listener.shutdown()
        self._thread.join()

    def _run(self) -> None:
        """Run the server thread until it is closed."""
        try:
            self._listener.serve_forever(_LOOK_S)
        finally:
            with contextlib.suppress(OSError):  # remove the socket file only if it is still this server's
                if os.stat(self.path).st_ino == self._inode:
                    os.unlink(self.path)
                    os.unlink(lock_path(self.path))
            self._listener.server_close()
            os.close(self._lock_file)

    def _reply(self, line: bytes) -> bytes:
        """Carry out one request; always return a reply."""
        try:
            if self._closing:
                raise InputError("the server has ended")
            fields = _parsed_request(line)
            command = fields.pop("command", None)
            if not isinstance(command, str) or command not in self._handlers:
                commands = ", ".join(sorted(self._handlers))
                raise InputError(f"command = {command!r:.80}: expected one of {commands}")
            with self._lengthy_ones.get(command, self._brief_one):
                reply = _encoded({"ok": True, **self._handlers[command](fields)})
            if len(reply) > _LARGEST_REPLY:
                raise InputError(f"reply: expected at most {_LARGEST_REPLY} bytes, got {len(reply)}")
            return reply
        except BaseException as error:  # a command's fault or exit must not end the channel
            text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            return _encoded({"ok": False, "error": " ".join(text.split())[:2000]})


class _Listener(socketserver.ThreadingUnixStreamServer):
    """Socket of a server, which answers each connection in a thread of its own."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, path: Path, reply: Callable[[bytes], bytes]) -> None:
        self.reply = reply
        super().__init__(os.fspath(path), _Conversation, bind_and_activate=False)
        self.socket.close()
        self.socket = bound_listener(path)

    def handle_error(self, request: object, client_address: object) -> None:
        """Print nothing: a connection that fails is closed."""


class _Conversation(socketserver.StreamRequestHandler):
    """Request of one connection, which is closed when it is idle for too long."""

    server: _Listener

    def setup(self) -> None:
        """Limit the time for which a client may be idle."""
        self.request.settimeout(_IDLE_S)
        super().setup()

    def handle(self) -> None:
        """Answer the request."""
        with contextlib.suppress(OSError):  # it is gone, or idle
            line = self.rfile.readline(LARGEST_REQUEST)
            if line.endswith(b"\n") or len(line) == LARGEST_REQUEST:
                self.wfile.write(self.server.reply(line))


# Messages -------------------------------------------------------------------------------------------


def _encoded(message: Mapping[str, object], *, exact: bool = False) -> bytes:
    return to_json(message, exact=exact).encode() + b"\n"


def _parsed_request(line: bytes) -> dict[str, object]:
    if not line.endswith(b"\n"):
        raise InputError(f"request: expected at most {LARGEST_REQUEST} bytes in one line")
    try:
        message = parse_json(line.decode())
    except ValueError:
        message = None
    if not isinstance(message, dict):
        raise InputError(f"request: expected a JSON object in one line, got {line[:40]!r}")
    return message


def changes_of(fields: Mapping[str, object]) -> dict[str, object]:
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
        try:
            return connection.connect(os.fspath(path))
        except BlockingIOError:  # many others are connecting
            if time.monotonic() > end:
                raise TimeoutError from None
            time.sleep(0.01)


def _checked_reply(server: str, line: bytes) -> dict[str, object]:
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
