"""Frames in PNG files, one per file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from faintspot.base.errors import InputError
from faintspot.io.arrays.raw import WholeArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, one_line
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
        try:
            with image.open(path, formats=["PNG"]) as opened:
                (width, height), mode = opened.size, opened.mode
        except Exception as error:  # Pillow raises many kinds of errors on damaged files
            raise InputError(f"{path}: expected a whole PNG file ({one_line(error)})") from None
        if mode not in _TYPES:
            raise InputError(f"{path}: expected a grey image of 8 or 16 bits, got mode {mode}")

        def load() -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
            with image.open(path, formats=["PNG"]) as opened:
                return np.asarray(opened)

        return WholeArray(str(path), (height, width), np.dtype(_TYPES[mode]), load)
