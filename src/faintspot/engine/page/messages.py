"""Binary messages to the page: values as JSON, followed by arrays.

A message starts with the length of the JSON text in four bytes, little-endian. The text follows, padded to
eight bytes: {"kind": ..., "values": {...}, "arrays": {name: [type, shape, offset]}}. Then come the arrays,
each padded to eight bytes; offsets count from the first one.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from faintspot.base.json_text import to_json

_ALIGN = 8


def packed(kind: str, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> bytes:
    """Return a message; numbers that are not finite become null in values, and stay in arrays."""
    described: dict[str, object] = {}
    blocks: list[bytes] = []
    offset = 0
    for name, array in (arrays or {}).items():
        data = array.tobytes()
        described[name] = [array.dtype.name, list(array.shape), offset]
        blocks += [data, bytes(-len(data) % _ALIGN)]
        offset += len(data) + len(blocks[-1])
    head = {"kind": kind, "values": values, "arrays": described}
    text = to_json(head).encode()
    text += b" " * (-(len(text) + 4) % _ALIGN)
    return b"".join([struct.pack("<I", len(text)), text, *blocks])
