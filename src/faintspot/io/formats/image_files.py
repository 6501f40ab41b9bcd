"""Frames in image files: PNG, BMP and JPEG, one per file; TIFF pages and stacks of cameras and ImageJ."""

import importlib.util
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, MissingExtraError, load_package
from faintspot.io.file_format import FileFormat
from faintspot.io.fits_units import StreamedArray, check_present
from faintspot.io.stored_array import CHANNELS, EQUAL_COLOURS, StoredArray, grey, one_channel
from faintspot.io.zarr_store import check_inflated, is_surely_small

_GREY = {"L": "u1", "I;16": "u2", "I": "i4"}
_COLOUR = ("RGB", "RGBA", "LA")


class _Image(FileFormat):
    """A grey image of 8 or 16 bits, or one in colours whose channels are equal or selected by their name."""

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the image, or its channel `key`: red, green or blue."""
        image = load_package("PIL.Image")
        with image.open(path, formats=[self.name]) as opened:
            (width, height), mode, tiles = opened.size, opened.mode, str(getattr(opened, "tile", ""))
        is_colour = mode in _COLOUR
        if key is not None and not (is_colour and key in CHANNELS):
            raise InputError(
                f"{path}: a grey {self.name} file holds one unnamed image, expected no key, got {key!r}"
            )
        if mode not in _GREY and not is_colour:
            raise InputError(f"{path}: expected a grey image of 8 or 16 bits, got mode {mode}")
        if is_colour and ";16" in tiles:
            raise InputError(
                f"{path}: expected 8 bits of a colour, got 16, of which 8 would be lost; save it in grey"
            )

        def load() -> NDArray[np.generic]:
            with image.open(path, formats=[self.name]) as opened:
                values = np.asarray(opened)
            if not is_colour:
                return values
            return grey(str(path), values) if key is None else one_channel(values, key)

        return StoredArray.whole(
            str(path) if key is None else f"{path}:{key}",
            (height, width),
            np.dtype(_GREY.get(mode, "u1")),
            load,
            note=EQUAL_COLOURS if is_colour and key is None else "",
        )


class Png(_Image):
    """An image in a PNG file."""

    name = "PNG"
    signatures = (b"\x89PNG\r\n\x1a\n",)


class Bmp(_Image):
    """An image in a BMP file."""

    name = "BMP"
    signatures = (b"BM",)


class Jpeg(_Image):
    """An image in a JPEG file, whose compression changes faint values."""

    name = "JPEG"
    signatures = (b"\xff\xd8\xff",)


_PLAIN = (1, 8, 32946)  # uncompressed or deflated
_CODECS = {8: "deflate", 32946: "deflate", 34925: "lzma", 34926: "zstd", 50000: "zstd"}


class Tiff(FileFormat):
    """Frames as pages, or as one stack after the first page; including BigTIFF."""

    name = "TIFF"
    signatures = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the pages of a file, or those of the series whose number is `key`.

        A series in tifffile is a set of pages written together. Raises InputError when pages differ in size
        or type.
        """
        with _complaints() as complaints, load_package("tifffile").TiffFile(path) as file:
            len(file.pages)  # follows all links between pages, and so complains of a circle
            chosen = _choose(path, list(file.series), key)
            name = f"{path}:{key}" if key is not None else str(path)
            array = _array(name, path, [file.series[number] for number in chosen], chosen)
        if complaints:
            raise ValueError(complaints[0])
        return array


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """Collect the errors that tifffile logs when it drops damaged pages; pass none of its messages on."""
    messages: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            messages.append(record.getMessage())
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(keep)
    try:
        yield messages
    finally:
        logger.removeFilter(keep)


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
    is_colour = len(size) == 3 and size[-1] in (3, 4)
    if not is_colour and (series.keyframe.samplesperpixel != 1 or len(size) != 2):
        raise InputError(f"{name}: expected grey frames, got pages of shape {size}")
    count = sum(item.size for item in chosen) // math.prod(size)
    shape = (count, *size[:2]) if count > 1 else size[:2]
    dtype = np.dtype(series.dtype).newbyteorder(series.parent.byteorder)
    if len(chosen) == 1 and series.dataoffset is not None and not is_colour:
        offset = series.dataoffset
        check_present(name, path, offset + math.prod(shape) * dtype.itemsize)
        return StoredArray(
            name,
            shape,
            dtype,
            lambda files: StreamedArray(files.enter_context(path.open("rb")), offset, dtype, shape),
        )

    def open_pages(files: ExitStack) -> object:
        file = files.enter_context(load_package("tifffile").TiffFile(path))
        pages = _Pages(path, [page for number in numbers for page in file.series[number].pages])
        return pages if count > 1 else pages[0:1][0]

    chunks = (*(1 for _ in shape[:-2]), *series.keyframe.chunks[:2])  # strips or tiles
    note = EQUAL_COLOURS if is_colour else ""
    return StoredArray(name, shape, dtype, open_pages, note=note, chunks=chunks)


class _Pages:
    """Pages that are decompressed individually."""

    def __init__(self, path: Path, pages: Sequence[object]) -> None:
        self._path, self._pages = path, pages

    def __getitem__(self, part: slice) -> NDArray[Any]:
        """Return pages, decoded by tifffile if possible, else by Pillow."""
        pages = np.stack([self._decoded(page) for page in self._pages[part]])
        return pages if pages.ndim == 3 else grey(str(self._path), pages, selectable=False)

    def _decoded(self, page: Any) -> NDArray[np.generic]:
        if page.compression in _PLAIN or importlib.util.find_spec("imagecodecs"):
            self._check(page)
            return np.asarray(page.asarray(maxworkers=1))
        if page.dtype.itemsize > 4:
            raise MissingExtraError("imagecodecs", "io", f"Reading {page.compression.name} of {page.dtype}")
        with load_package("PIL.Image").open(self._path, formats=["TIFF"]) as image:
            image.seek(page.index)
            return np.asarray(image)

    def _check(self, page: Any) -> None:
        """Refuse strips or tiles that inflate to more than one may have."""
        codec = _CODECS.get(int(page.compression), "")
        for offset, size in zip(page.dataoffsets, page.databytecounts, strict=False):
            if codec and not is_surely_small(size, codec):
                page.parent.filehandle.seek(offset)
                check_inflated(str(self._path), page.parent.filehandle.read(size), codec)
