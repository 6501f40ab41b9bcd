"""Files that are never seen half written, whatever ends the program or the machine."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from faintspot.base.errors import InputError

_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again, what is finished is kept",
    errno.EDQUOT: "the disk quota is used up: free some space and run again, what is finished is kept",
    errno.EACCES: "no permission to write there: choose another folder",
    errno.EPERM: "no permission to write there: choose another folder",
    errno.EROFS: "the file system is read-only: choose another folder",
}
# What a name of ours ends with; anything else behind a dot is part of the name, as in night.1.
_ENDINGS = (".toml", ".npz", ".zarr", ".fits", ".fits.gz", ".csv", ".html", ".json")
Content = bytes | str | Callable[[BinaryIO], object]
"""What a file is to contain, a text as UTF-8; or what writes that to a stream."""

# Folders that cannot be synchronised: of some file systems, and those that may be written but not read.
_CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)


@contextlib.contextmanager
def output_errors(path: str | Path) -> Iterator[None]:
    """Turn an OSError while writing into one line that names `path` and says what to do."""
    try:
        yield
    except OSError as error:
        reason = _ADVICE.get(error.errno or 0, f"{error.strerror or error}: choose another name")
        raise InputError(f"{path}: cannot be written: {reason}") from None


def check_regular(path: str | Path) -> int:
    """Return the size of a file in bytes; refuse a pipe or a device, which may never end.

    Raises
    ------
    InputError
        When it is neither a file nor a folder.
    OSError
        When there is no such file, or it is a folder.
    """
    found = os.stat(path)
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(found.st_mode):
        kind = "a named pipe" if stat.S_ISFIFO(found.st_mode) else "a device or a socket"
        raise InputError(f"{path}: expected a regular file, got {kind}")
    return found.st_size


def read_bytes(path: str | Path, what: str, most: int) -> bytes:
    """Return the content of a file that should hold `what`, in at most so many bytes.

    Raises
    ------
    InputError
        When it is larger, or no regular file.
    OSError
        When it cannot be read.
    """
    size = check_file_size(path, what, most)
    with Path(path).open("rb") as stream:
        return stream.read(size)


def check_file_size(path: str | Path, what: str, most: int) -> int:
    """Return a file's size, refuse one of more than so many bytes; raises what `read_bytes` raises."""
    if (size := check_regular(path)) > most:
        raise InputError(f"{path}: has {size:,} bytes: expected {what} of at most {most:,}")
    return size


def derived(path: str | Path, ending: str) -> Path:
    """Return the file beside `path` that is named after it: its name without its own ending, and `ending`."""
    path = Path(path)
    own = next((each for each in _ENDINGS if path.name.lower().endswith(each)), "")
    return path.with_name(f"{path.name[: len(path.name) - len(own)]}{ending}")


def write_atomically(path: str | Path, content: Content) -> None:
    """Write a file in one step: a reader sees the old or the new one, also after the power has failed.

    Parameters
    ----------
    path : path
        The file; its folder must exist.
    content : bytes, str or callable
        See `Content`.

    Raises
    ------
    InputError
        When it cannot be written; what was there before is still there.
    """
    path = Path(path)
    with output_errors(path):
        if not path.parent.is_dir():
            raise InputError(
                f"{path}: cannot be written: the folder {path.parent} does not exist: "
                "create it or choose another"
            )
        replace_file(path, content)


def replace_file(path: Path, content: Content) -> None:
    """Do what `write_atomically` does, with an OSError as it comes, for those who name another file in it."""
    # A name of its own for each writer: two that write the same file must not share it.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.new")
    try:
        with temporary.open("wb") as stream:
            if callable(content):
                content(stream)
            else:
                stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk, where the file system can do that."""
    try:
        sync_file(path)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise


def parse_json(text: str | bytes) -> Any:
    """Return what a JSON text holds.

    Raises
    ------
    ValueError
        When it is not JSON, or nested so deeply that Python gives up.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
