"""A Unix socket that only one user can open, and that at most one living server holds."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import socket
import stat
import struct
import tempfile
from pathlib import Path

from faintspot.base.errors import InputError

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
