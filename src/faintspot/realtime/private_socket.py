"""A Unix socket that only one user can open, and that one living server holds."""

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
_LONGEST_PATH = 107  # bytes, of a Unix socket on Linux
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_PREFIX, _SUFFIX = "faintspot-", ".sock"
ENGINE, TELESCOPE = "engine", "telescope"
_TELESCOPE_SUFFIX = f"+{TELESCOPE}"  # no name has a "+"


def socket_path(name: str, kind: str = ENGINE) -> Path:
    """Return where the engine, or telescope, of that name listens: in a folder that only this user can open.

    $XDG_RUNTIME_DIR/faintspot-NAME.sock, or, where that is not a folder of the user's, in a private one in
    the temporary directory, which the server makes.

    Raises
    ------
    InputError
        For a name that is not made of letters, digits, "_", "." and "-".
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(
            f'name = {name!r:.80}: expected up to 64 letters, digits, "_", "." or "-", '
            "the first a letter or digit"
        )
    folder = Path(tempfile.gettempdir()) / f"faintspot-{os.geteuid()}"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    # After a change of user the variable may still name the other one's folder.
    if runtime and os.path.isdir(runtime) and os.stat(runtime).st_uid == os.geteuid():
        folder = Path(runtime)
    kind_suffix = _TELESCOPE_SUFFIX if kind == TELESCOPE else ""
    return folder / f"{_PREFIX}{name}{kind_suffix}{_SUFFIX}"


def server_of(path: Path) -> tuple[str, str]:
    """Return what listens there, an engine or a telescope, and its name; any other path is its own name."""
    name = path.name
    if not (name.startswith(_PREFIX) and name.endswith(_SUFFIX)):
        return ENGINE, str(path)
    name = name[len(_PREFIX) : -len(_SUFFIX)]
    if name.endswith(_TELESCOPE_SUFFIX):
        return TELESCOPE, name.removesuffix(_TELESCOPE_SUFFIX)
    return ENGINE, name


def locked_beside(path: Path) -> int:
    """Make the folder, and lock the file beside the socket that says that a server lives here.

    Returns
    -------
    int
        The lock file's descriptor; closing it, or the end of the process, gives the lock back.

    Raises
    ------
    InputError
        When another server holds it, or the folder is not private.
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
            os.close(lock_file)  # a server that closed removed it between opening and locking
    except OSError as error:
        raise InputError(f"{path}: cannot listen there: {error.strerror}") from None


def lock_path(path: Path) -> Path:
    """Return the lock file of a socket; only who holds the lock may remove it."""
    return path.with_name(f"{path.name}.lock")


def _locked(path: Path) -> int:
    """Open and lock the lock file; the system gives the lock back however the process ends."""
    lock_file = os.open(lock_path(path), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock_file)
        kind, name = server_of(path)
        article = "an" if kind == ENGINE else "a"
        raise InputError(f"{article} {kind} runs under the name {name} already") from None
    return lock_file


def _check_private(folder: Path) -> None:
    """Refuse a folder in which others could put a socket in this one's place."""
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise InputError(f"{folder}: expected a folder of your own that nobody else may write to")


def bound_listener(path: Path) -> socket.socket:
    """Return the listening socket; what a dead server left is replaced. To be called with the lock held.

    Raises
    ------
    InputError
        When something else than a socket lies there, or none can be made.
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
    """Return the user at the other end, as the kernel says."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("iII"))
    return int(struct.unpack("iII", credentials)[1])
