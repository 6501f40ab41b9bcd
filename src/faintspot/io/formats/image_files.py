"""Frames in image files, one per file: PNG, BMP and JPEG, read by Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.stored_array import CHANNELS, EQUAL_COLOURS, StoredArray, grey, one_channel
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.optional_packages import load_pillow

_GREY = {"L": "u1", "I;16": "u2", "I": "i4"}
_COLOUR = ("RGB", "RGBA", "LA")


class _Image(FileFormat):
    """A grey image of 8 or 16 bits, or one in colours whose channels are equal or selected by their name."""

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the image, or its channel `key`: red, green or blue."""
        image = load_pillow()
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
