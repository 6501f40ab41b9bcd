"""Arrays in files that IDL's SAVE wrote (.sav), read by SciPy; fields of structures as STRUCTURE.FIELD."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_file_size
from faintspot.io.arrays.stored_array import MOST_WHOLE_BYTES, StoredArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import choose_name, one_line

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
        chosen = choose_name(path, {name: array.ndim for name, array in arrays.items()}, wanted)
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
