"""Files: size limits, atomic writes that leave nothing incomplete, checked .npz files, objects that close."""

import contextlib
import csv
import errno
import io
import math
import os
import secrets
import stat
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Self

import numpy as np

from faintspot.base.errors import InputError, errors_within

MOST_NUMBERS = 1 << 28
"""Maximum number of values, 1 GB in float32: a frame of 16,384 x 16,384 pixels."""


MOST_TEXT_BYTES = 1 << 26
"""Maximum size of metadata (JSON text)."""


def check_size(
    name: str, sides: Sequence[int], most: int = MOST_NUMBERS, what: str = "", hint: str = ""
) -> None:
    """Raise an error for an array of more than `most` numbers.

    Parameters
    ----------
    name : str
        Name in messages.
    sides : sequence of int
        Shape of the array, or counts to multiply.
    most : int
    what : str
        Unit of the count, such as "pixels".
    hint : str
        Advice on what to change.

    Raises
    ------
    InputError
        If it is larger.
    """
    if math.prod(sides) > most:
        name = f"{name} = {' x '.join(map(str, sides))}"
        raise InputError(f"expected at most {most:,} {what or 'numbers'}{hint and f'; {hint}'}", name=name)


def check_bytes(name: object, total: int, most: int, what: str) -> None:
    """Raise an error if `what`, read from a file, needs more than `most` bytes of memory.

    Raises
    ------
    InputError
        If it does.
    """
    if total > most:
        size, limit = f"{total / 2**20:,.0f} MiB", f"{most / 2**20:,.0f} MiB"
        raise InputError(f"{name}: needs {size} of memory, expected {what} of at most {limit}")


_USUAL_MEMORY = 8 << 30  # bytes, assumed on Windows


def memory_bytes() -> int:
    """Return the memory of the machine in bytes."""
    if not hasattr(os, "sysconf"):
        return _USUAL_MEMORY
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


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
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)  # Windows synchronises no other
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


MOST_BYTES = 1 << 29
"""Maximum total memory of the arrays of a file."""


def unpacked(path: str | Path, what: str, names: Collection[str] | None, most: int) -> dict[str, Any]:
    """Return the named arrays that exist, or all, if they need at most `most` bytes.

    Raises
    ------
    InputError
        If they need more, or the path is not a regular file.
    Exception
        If the file is damaged, or no .npz file.
    """
    check_regular(path)
    with Path(path).open("rb") as stream:
        if not zipfile.is_zipfile(stream):  # np.load would read a .npy file whole
            raise zipfile.BadZipFile("not a zip file")
        stream.seek(0)
        archive = np.load(stream, allow_pickle=False)
        members = [item for item in archive.zip.infolist() if item.filename.endswith(".npy")]
        n_bytes = {item.filename.removesuffix(".npy"): item.file_size for item in members}
        chosen = [name for name in n_bytes if names is None or name in names]
        check_bytes(path, sum(n_bytes[name] for name in chosen), most, what)
        return {name: archive[name] for name in chosen}


def save_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a compressed file atomically, with `write_atomically`.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    write_atomically(path, lambda stream: np.savez_compressed(stream, **arrays))


def read_arrays(
    path: str | Path, what: str, names: Sequence[str] | None = None, optional: Sequence[str] = ()
) -> dict[str, Any]:
    """Read the named arrays, or all, from a file that should contain `what` in at most `MOST_BYTES`.

    Raises
    ------
    InputError
        If it cannot be read, is too large, or a required array is missing.
    """
    try:
        values = unpacked(path, what, names, MOST_BYTES)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except Exception:  # a damaged archive can raise any error of its decoder
        raise InputError(f"{path}: expected {what} (.npz), got something else") from None
    for name in names or ():
        if name not in values and name not in optional:
            raise InputError(f"{path}: expected {what}, but {name} is missing")
    return values


class NpzFile:
    """Object with arrays, texts and numbers that are its constructor's arguments, saved in an .npz file."""

    WHAT: ClassVar[str]
    """Kind of file, named in errors."""
    FIELDS: ClassVar[tuple[str, ...]] = ()
    """Names of the values in a file. Default: the fields of a dataclass."""
    OPTIONAL: ClassVar[tuple[str, ...]] = ("index",)
    """Names of those that may be None."""
    FORMAT: ClassVar[int | None] = None
    """Number that a change of the fields changes: files of another one are refused. None: files have none."""

    def save(self, path: str | Path) -> None:
        """Write the values to a compressed file (.npz), which is never seen half written.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        values = {"format": self.FORMAT, **{name: getattr(self, name) for name in self._names()}}
        save_arrays(path, {name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            If the file cannot be read or holds something else.
        """
        values = read_arrays(path, cls.WHAT, cls._names() if cls.FORMAT is None else None, cls.OPTIONAL)
        version = values.pop("format", None)
        has_all = {*values, *cls.OPTIONAL} == {*cls._names(), *cls.OPTIONAL}
        if cls.FORMAT is not None and (version != cls.FORMAT or not has_all):
            raise InputError(f"{path}: expected {cls.WHAT} of format {cls.FORMAT}, got something else")
        with errors_within(path):
            return cls(**{name: _restored(value) for name, value in values.items()})

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return cls.FIELDS or tuple(item.name for item in fields(cls))  # type: ignore[arg-type]


def _restored(value: Any) -> object:
    """Return an array as what it was: a row of texts is a tuple, what has no axes a plain number or text."""
    if value.ndim == 0:
        return value.item()
    return tuple(value.tolist()) if value.dtype.kind == "U" and value.ndim == 1 else value


class Closing:
    """Mixin for objects with `close`, which a `with` block calls at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release all resources of the object."""
        raise NotImplementedError
