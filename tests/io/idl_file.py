"""Files as IDL's SAVE writes them: variables, and structures of arrays."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

_CODES = {"uint8": 1, "int16": 2, "int32": 3, "float32": 4, "float64": 5, "uint32": 13, "int64": 14}


def write(path: Path, variables: dict[str, Any], compressed: bool = False) -> Path:
    """Write arrays and dicts of arrays as variables of an IDL file."""
    content = b"SR\0\6" if compressed else b"SR\0\4"
    for name, value in variables.items():
        body = _text(name) + (_structure(value) if isinstance(value, dict) else _variable(np.asarray(value)))
        body = zlib.compress(body) if compressed else body
        following = len(content) + 16 + len(body)
        content += struct.pack(">iIII", 2, following, 0, 0) + body
    path.write_bytes(content + struct.pack(">iIII", 6, 0, 0, 0))
    return path


def _longs(*values: int) -> bytes:
    return struct.pack(f">{len(values)}i", *values)


def _text(text: str) -> bytes:
    octets = text.upper().encode()
    return _longs(len(octets)) + octets + bytes(-len(octets) % 4)


def _described(array: np.ndarray) -> bytes:
    sides = [*reversed(array.shape), *[1] * (8 - array.ndim)]
    return _longs(8, 0, array.nbytes, array.size, array.ndim, 0, 0, 8, *sides)


def _variable(array: np.ndarray) -> bytes:
    code = _CODES[array.dtype.name]
    if array.ndim == 0:
        return _longs(code, 0, 7) + _values(array)
    return _longs(code, 4) + _described(array) + _longs(7) + _values(array)


def _structure(fields: dict[str, Any]) -> bytes:
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    tags = [part for array in arrays.values() for part in (0, _CODES[array.dtype.name], 4)]
    one = np.zeros(1, np.int32)
    head = _longs(8, 4 | 32) + _described(one) + _longs(9) + _text("") + _longs(0, len(arrays), 0)
    described = b"".join(map(_text, arrays)) + b"".join(map(_described, arrays.values()))
    return head + _longs(*tags) + described + _longs(7) + b"".join(map(_values, arrays.values()))


def _values(array: np.ndarray) -> bytes:
    stored = array.astype(array.dtype.newbyteorder(">")).tobytes()
    if array.dtype == np.int16:
        stored = array.astype(">i4").tobytes()
    elif array.dtype == np.uint8:
        stored = _longs(array.nbytes) + stored
    return stored + bytes(-len(stored) % 4)
