"""Frames in PNG files, one per file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.stored_array import StoredArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.optional_packages import load_pillow

_TYPES = {"L": "u1", "I;16": "u2", "I": "i4"}


class Png(FileFormat):
    """A greyscale image of 8 or 16 bits."""

    name = "PNG"
    signatures = (b"\x89PNG\r\n\x1a\n",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the image."""
        if key is not None:
            raise InputError(f"{path}: a PNG file holds one unnamed image, expected no key, got {key!r}")
        image = load_pillow()
        with image.open(path, formats=["PNG"]) as opened:
            (width, height), mode = opened.size, opened.mode
        if mode not in _TYPES:
            raise InputError(f"{path}: expected a grey image of 8 or 16 bits, got mode {mode}")

        def load() -> NDArray[Any]:
            with image.open(path, formats=["PNG"]) as opened:
                return np.asarray(opened)

        return StoredArray.whole(str(path), (height, width), np.dtype(_TYPES[mode]), load)
