"""Atomic writing of files: a file is never left incomplete if the program or the machine stops."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from faintspot.base.errors import InputError

_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again; completed results are kept",
    errno.EDQUOT: "the disk quota is used up: free some space and run again; completed results are kept",
    errno.EACCES: "no permission to write there: choose another folder",
    errno.EPERM: "no permission to write there: choose another folder",
    errno.EROFS: "the file system is read-only: choose another folder",
}
# Known file extensions; any other text after a dot is part of the name, as in night.1.
_ENDINGS = (".toml", ".npz", ".zarr", ".fits", ".fits.gz", ".csv", ".html", ".json")
Content = bytes | str | Callable[[BinaryIO], object]
"""Content of a file (text is encoded as UTF-8), or a function that writes it to a stream."""

# Folders that cannot be synchronised: on some file systems, and folders that are writable but not readable.
_CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)


@contextlib.contextmanager
def output_errors(path: str | Path) -> Iterator[None]:
    """Convert an OSError on writing to a one-line error that names `path` and says what to do."""
    try:
        yield
    except OSError as error:
        reason = _ADVICE.get(error.errno or 0, f"{error.strerror or error}: choose another name")
        raise InputError(f"{path}: cannot be written: {reason}") from None


def check_regular(path: str | Path) -> int:
    """Return the size of a file in bytes; reject a pipe or a device, which may never end.

    Raises
    ------
    InputError
        If it is neither a file nor a folder.
    OSError
        If the file does not exist, or is a folder.
    """
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(status.st_mode):
        kind = "a named pipe" if stat.S_ISFIFO(status.st_mode) else "a device or a socket"
        raise InputError(f"{path}: expected a regular file, got {kind}")
    return status.st_size


def read_bytes(path: str | Path, what: str, most: int) -> bytes:
    """Return the content of a file that should contain `what`, with at most `most` bytes.

    Raises
    ------
    InputError
        If it is larger, or not a regular file.
    OSError
        If it cannot be read.
    """
    size = check_file_size(path, what, most)
    with Path(path).open("rb") as stream:
        return stream.read(size)


def read_lines(path: str | Path, what: str, most: int) -> list[str]:
    """Return the lines of a text file; parameters and errors are those of `read_bytes`."""
    return read_bytes(path, what, most).decode("utf-8").splitlines()


def check_file_size(path: str | Path, what: str, most: int) -> int:
    """Return the size of a file of at most `most` bytes; errors are those of `read_bytes`."""
    if (size := check_regular(path)) > most:
        raise InputError(f"{path}: has {size:,} bytes, expected {what} of at most {most:,}")
    return size


def check_ending(path: Path, *endings: str) -> None:
    """Refuse the name of a file to write that has another ending."""
    if path.suffix.lower() not in endings:
        raise InputError(f"{path}: expected a name ending in {', '.join(endings)}")


def derived(path: str | Path, ending: str) -> Path:
    """Return a path beside `path` in which `ending` replaces its known extension."""
    path = Path(path)
    path = path if path.name else path.resolve()  # "." and ".." as parts of a path have no name
    if not path.name:
        raise InputError(f"{path}: expected the name of a file or folder, got the root of all")
    known_ending = next((ending for ending in _ENDINGS if path.name.lower().endswith(ending)), "")
    return path.with_name(f"{path.name[: len(path.name) - len(known_ending)]}{ending}")


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV text."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def write_atomically(path: str | Path, content: Content) -> None:
    """Write a file atomically: readers see the old or the new content, also after a power failure.

    Parameters
    ----------
    path : path
        Path of the file; its folder must exist.
    content : bytes, str or callable
        See `Content`.

    Raises
    ------
    InputError
        If it cannot be written; the previous content is then still there.
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
    """Write a file like `write_atomically`, but let an OSError pass, for callers that convert it."""
    # Each writer uses its own temporary name, since two may write the same file.
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
    """Wait until the content of a file is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on disk, if the file system supports it."""
    try:
        sync_file(path)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise
