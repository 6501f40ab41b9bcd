"""Frames in TIFF files: single pages and stacks, as written by cameras and ImageJ."""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.io.arrays.inflation import check_inflated
from faintspot.io.arrays.raw import RawArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, one_line
from faintspot.io.optional_packages import load_pillow

_PLAIN = (1, 8, 32946)  # uncompressed or deflated


class Tiff(FileFormat):
    """Frames as pages, or as one stack after the first page; including BigTIFF."""

    name = "TIFF"
    signatures = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the pages of a file, or those of the series whose number is `key`.

        A series in tifffile is a set of pages written together. Raises InputError when pages differ in size
        or type.
        """
        _check_chain(path)
        complaints = _Complaints()
        try:
            with complaints, _load_tifffile().TiffFile(path) as file:
                chosen = _choose(path, list(file.series), key)
                name = f"{path}:{key}" if key is not None else str(path)
                array = _array(name, path, [file.series[number] for number in chosen], chosen)
        except (InputError, OSError, MissingExtraError):
            raise
        except Exception as error:  # tifffile raises many kinds of errors on broken files
            raise InputError(f"{path}: expected a whole TIFF file ({one_line(error)})") from None
        if complaints.first:
            raise InputError(f"{path}: expected a whole TIFF file ({complaints.first})")
        return array


def _check_chain(path: Path) -> None:
    """Refuse pages that link to each other in a circle, which tifffile would read without end."""
    with path.open("rb") as stream:
        start = stream.read(8)
        order: Literal["little", "big"] = "little" if start[:2] == b"II" else "big"
        big = int.from_bytes(start[2:4], order) == 43
        count_bytes, tag_bytes, offset_bytes = (8, 20, 8) if big else (2, 12, 4)
        offset = int.from_bytes(stream.read(8) if big else start[4:8], order)
        seen: set[int] = set()
        end = path.stat().st_size
        while 0 < offset < end:
            if offset in seen:
                raise InputError(
                    f"{path}: expected a whole TIFF file (its pages link to each other in a circle)"
                )
            seen.add(offset)
            stream.seek(offset)
            after = offset + count_bytes + tag_bytes * int.from_bytes(stream.read(count_bytes), order)
            stream.seek(min(after, end))
            offset = int.from_bytes(stream.read(offset_bytes), order)


class _Complaints(logging.Handler):
    """Context that keeps the first error that tifffile logs when it drops pages."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.first = ""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message in one line."""
        self.first = self.first or " ".join(record.getMessage().split())

    def __enter__(self) -> None:
        self._logger = logging.getLogger("tifffile")
        self._propagate, self._logger.propagate = self._logger.propagate, False
        self._logger.addHandler(self)

    def __exit__(self, *_: object) -> None:
        self._logger.removeHandler(self)
        self._logger.propagate = self._propagate


def _load_tifffile() -> Any:
    try:
        import tifffile
    except ImportError:
        raise MissingExtraError("tifffile", "io", "Reading a TIFF file") from None
    return tifffile


def _choose(path: Path, series: list[Any], key: str | None) -> list[int]:
    """Return the numbers of the series to read: the named one, or all when they are alike."""
    everything = list(range(len(series)))
    if key is None and len({(item.keyframe.shape, item.dtype) for item in series}) == 1:
        return everything
    listed = ", ".join(
        f"{i}: {' x '.join(map(str, item.shape))} {item.dtype}" for i, item in enumerate(series)
    )
    if key is None:
        raise InputError(
            f"{path}: expected pages of one size and type; it contains {listed}; "
            f"select some with {path.name}:NUMBER"
        )
    if not key.isdecimal() or int(key) not in everything:
        raise InputError(f"{path}: no pages {key!r}; it contains {listed}")
    return [int(key)]


def _array(name: str, path: Path, chosen: list[Any], numbers: list[int]) -> StoredArray:
    """Return the pages of series as one array: as plain bytes if contiguous, else page by page."""
    series = chosen[0]
    size = tuple(series.keyframe.shape)
    if series.keyframe.samplesperpixel != 1 or len(size) != 2:
        raise InputError(f"{name}: expected grey frames, got pages of shape {size}")
    count = sum(item.size for item in chosen) // (size[0] * size[1])
    shape = (count, *size) if count > 1 else size
    dtype = np.dtype(series.dtype)
    if len(chosen) == 1 and series.dataoffset is not None:
        needed = series.dataoffset + int(np.prod(shape)) * dtype.itemsize
        if path.stat().st_size < needed:
            raise InputError(
                f"{name}: truncated: it states data up to byte {needed}, "
                f"the file has {path.stat().st_size} bytes"
            )
        return RawArray(
            name,
            lambda: path.open("rb"),
            offset=series.dataoffset,
            dtype=dtype.newbyteorder(series.parent.byteorder),
            shape=shape,
            forward_only=False,
        )
    return _Pages(name, path, numbers, shape, dtype)


class _Pages:
    """Pages that are decompressed individually."""

    def __init__(
        self, name: str, path: Path, numbers: list[int], shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        self.name = name
        self.shape = shape
        self.dtype: np.dtype[Any] = dtype.newbyteorder("=")
        self._path = path
        self._numbers = numbers
        self._file: Any = None
        self._pages: list[Any] = []

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return pages `start` to `stop`, in native byte order; for a single page, rows."""
        if len(self.shape) == 2:
            return self._page(0)[start:stop]
        return np.stack([self._page(number) for number in range(start, stop)])

    def close(self) -> None:
        """Close the file; a later `read` opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None
            self._pages = []

    def _decoded(self, page: Any) -> NDArray[Any]:
        """Decode a page with tifffile if possible, else with Pillow."""
        with self._path.open("rb") as stream:
            for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
                stream.seek(offset)
                check_inflated(self.name, stream.read(count), 2 * page.nbytes)
        if page.compression in _PLAIN or importlib.util.find_spec("imagecodecs"):
            return np.asarray(page.asarray(maxworkers=1))
        if self.dtype.itemsize > 4:
            raise MissingExtraError("imagecodecs", "io", f"Reading {page.compression.name} of {self.dtype}")
        with load_pillow().open(self._path, formats=["TIFF"]) as image:
            image.seek(page.index)
            return np.asarray(image)

    def _page(self, number: int) -> NDArray[Any]:
        try:
            if self._file is None:
                self._file = _load_tifffile().TiffFile(self._path)
                self._pages = [page for i in self._numbers for page in self._file.series[i].pages]
            values = self._decoded(self._pages[number])
        except Exception as error:  # decompressors raise many kinds of errors
            self.close()
            raise InputError(
                f"{self.name}: frame {number} (counted from 0) cannot be read ({one_line(error)})"
            ) from None
        return values.astype(self.dtype, copy=False)
