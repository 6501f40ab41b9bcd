"""Frames in HDF5 and MATLAB files, and arrays that IDL's SAVE wrote (.sav)."""

import struct
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import check_file_size
from faintspot.io.file_format import FileFormat
from faintspot.io.stored_array import MOST_WHOLE_BYTES, StoredArray, choose_name, one_line
from faintspot.io.zarr_store import check_inflated, is_surely_small

_KEEPING_SIZE = (2, 3)  # shuffle, Fletcher's checksum
_CODECS = {
    1: "deflate",
    4: "szip",
    307: "bz2",
    32001: "blosc",
    32004: "hdf5-lz4",
    32008: "hdf5-lz4",
    32015: "zstd",
}
"""Compressing filters by number; of others (lzf), no chunk inflates to more than a hundred times its size."""


class Hdf5(FileFormat):
    """Frames in a data set, selected by its path in the file."""

    name = "HDF5"
    signatures: tuple[bytes, ...] = (b"\x89HDF\r\n\x1a\n",)
    matlab = False

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the data set at `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        h5py = load_package("h5py")
        with h5py.File(path, "r") as file:
            chosen = choose_name(path, _shapes(h5py, file), None if key is None else key.strip("/"))
            data_set = file[chosen]
            name, shape, chunks = f"{path}:{chosen}", data_set.shape, data_set.chunks
            compressions = _check(name, data_set)
            reverse = self.matlab and len(shape) > 1
            if reverse:  # MATLAB's (height, width, frames) is (frames, width, height) here
                shape, chunks = (sides and (*sides[:-2], *sides[:-3:-1]) for sides in (shape, chunks))

            def open_array(files: ExitStack) -> object:
                data_set = files.enter_context(h5py.File(path, "r"))[chosen]
                return _DataSet(name, data_set, reverse)

            options: dict[str, Any] = {"matlab": self.matlab, "chunks": chunks, "compressions": compressions}
            return StoredArray(name, shape, data_set.dtype, open_array, **options)


class Matlab73(Hdf5):
    """Variables of a MATLAB file; HDF5 stores their axes in reverse order: (height, width, frames)."""

    name = "MATLAB"
    signatures = (b"MATLAB 7",)
    matlab = True


def _shapes(h5py: Any, file: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of each data set by its path; links are not followed."""
    shapes: dict[str, tuple[int, ...]] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):  # MATLAB's internal data
            shapes[name] = item.shape or ()

    file.visititems(visit)
    return shapes


def _check(name: str, data_set: Any) -> int:
    """Refuse data in other files and Python objects; return how often chunks are compressed."""
    if data_set.is_virtual or data_set.external:
        raise InputError(f"{name}: expected data in this file, they are stored in other files")
    if data_set.dtype.hasobject:
        raise InputError(f"{name}: expected numbers, got {data_set.dtype}")
    return sum(code not in _KEEPING_SIZE for code in _filters(data_set))


def _filters(data_set: Any) -> list[int]:
    """Return the numbers of the filters of the chunks, in the order in which they were applied."""
    filters = data_set.id.get_create_plist()
    return [int(filters.get_filter(number)[0]) for number in range(filters.get_nfilters())]


class _DataSet:
    """A data set, or one whose last two axes are exchanged, whose chunks are checked before they are read."""

    def __init__(self, name: str, data_set: Any, reverse: bool) -> None:
        self._name, self._data_set, self._reverse = name, data_set, reverse
        self._large: set[tuple[int, ...]] = set()  # chunks that may inflate to more than the limit
        filters = enumerate(_filters(data_set))
        known = ((place, _CODECS[code]) for place, code in filters if code in _CODECS)
        self._place, self._codec = next(known, (0, ""))
        if self._codec and not is_surely_small(data_set.id.get_storage_size(), self._codec):
            data_set.id.chunk_iter(self._note)

    def _note(self, chunk: Any) -> None:
        if not (is_surely_small(chunk.size, self._codec) or chunk.filter_mask >> self._place & 1):
            self._large.add(chunk.chunk_offset)

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Return items of the first axis, or of a later one after numbers of the items of the first."""
        across = self._reverse and self._data_set.ndim == 2
        selection = (slice(None), part) if across else part if isinstance(part, tuple) else (part,)
        for first in self._large and self._chunks_of(selection):
            check_inflated(self._name, self._data_set.id.read_direct_chunk(first)[1], self._codec)
            self._large.remove(first)
        values = np.asarray(self._data_set[selection])
        return values.swapaxes(-1, -2) if self._reverse else values

    def _chunks_of(self, selection: tuple[Any, ...]) -> list[tuple[int, ...]]:
        """Return the large chunks that overlap a selection."""
        spans = [
            range(side)[item] if isinstance(item, slice) else range(item, item + 1)
            for item, side in zip(selection, self._data_set.shape, strict=False)
        ]
        return [
            first
            for first in self._large
            if all(
                at < span.stop and span.start < at + side
                for at, side, span in zip(first, self._data_set.chunks, spans, strict=False)
            )
        ]


_TYPES = {"double": "f8", "single": "f4", "logical": "u1"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}


class Matlab(FileFormat):
    """Frames in a variable (height, width, frames), which is read whole."""

    name = "MATLAB"
    signatures = (b"MATLAB 5",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the variable `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        import scipy.io  # slow import: a tenth of a second

        variables = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
        shapes = {
            name: shape if max(shape, default=0) > 1 else ()  # MATLAB stores numbers as 1 x 1 arrays
            for name, (shape, kind) in variables.items()
            if kind in _TYPES
        }
        chosen = choose_name(path, shapes, key)
        shape, kind = variables[chosen]

        def load() -> NDArray[Any]:
            values = scipy.io.loadmat(path, variable_names=[chosen], mat_dtype=True)[chosen]
            return np.asarray(np.moveaxis(values, -1, 0) if values.ndim > 2 else values)

        frames_first = (*shape[2:], *shape[:2]) if len(shape) < 4 else (shape[-1], *shape[:-1])
        return StoredArray.whole(f"{path}:{chosen}", frames_first, np.dtype(_TYPES[kind]), load, matlab=True)


_SIGNATURE, _COMPRESSED = b"SR\0\4", b"SR\0\6"
_HEAD = struct.Struct(">iII4x")  # kind of a record, place of the next one: low and high half
_END = 6


class Idl(FileFormat):
    """Variables of numbers and fields of structures; the file is read whole."""

    name = "IDL"
    signatures = (_SIGNATURE, _COMPRESSED)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the variable or field `key`, in which capitals do not count."""
        arrays = saved_arrays(path)
        wanted = None if key is None else key.strip().upper()
        chosen = choose_name(path, {name: array.shape for name, array in arrays.items()}, wanted)
        array = arrays[chosen]
        return StoredArray.whole(f"{path}:{chosen}", array.shape, array.dtype, lambda: array)

    def names(self, path: Path) -> list[str]:
        """Return the names of variables and fields."""
        return list(saved_arrays(path))


def saved_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the numbers of a file by name, such as "RX" or "A.DMCOMMAND".

    Raises
    ------
    InputError
        When the file is damaged, or larger than 1 GiB, also inflated.
    """
    import scipy.io  # slow import: a tenth of a second

    try:
        _check_records(path)
        variables = scipy.io.readsav(path)
    except InputError:
        raise
    except Exception as error:  # SciPy raises many kinds of errors on damaged files
        raise InputError(f"{path}: expected a whole IDL file ({one_line(error)})") from None
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in variables.items():
        _collect(arrays, name.upper(), value)
    return arrays


def _collect(arrays: dict[str, NDArray[Any]], name: str, value: Any) -> None:
    """Add the numbers of a variable, or those of the fields of its first structure."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        for field in value.dtype.names if value.size else ():
            _collect(arrays, f"{name}.{field.upper()}", value.reshape(-1)[field][0])
    elif np.asarray(value).dtype.kind in "iuf":
        arrays[name] = np.asarray(value)


def _check_records(path: Path) -> None:
    """Refuse records that do not follow each other, at which SciPy would not end, or inflate to too much."""
    size, total = check_file_size(path, "arrays", MOST_WHOLE_BYTES), 0
    with path.open("rb") as stream:
        is_compressed = stream.read(4) == _COMPRESSED
        while True:
            place = stream.tell()
            kind, low, high = _HEAD.unpack(stream.read(_HEAD.size))
            if kind == _END:
                return
            following = low + (high << 32)
            if not place + _HEAD.size <= following <= size:
                raise ValueError(f"its record at byte {place} does not end")
            if is_compressed:
                content = stream.read(following - stream.tell())
                total += _inflated(content, MOST_WHOLE_BYTES - total)
                if total > MOST_WHOLE_BYTES:
                    raise InputError(f"{path}: inflates to more than {MOST_WHOLE_BYTES >> 20:,} MiB")
            stream.seek(following)


def _inflated(content: bytes, most: int) -> int:
    """Return the size of inflated bytes, or a little more than `most`."""
    decoder, total = zlib.decompressobj(), 0
    while content and total <= most and not decoder.eof:
        total += len(decoder.decompress(content, 1 << 20))
        content = decoder.unconsumed_tail
    return total
