"""Small HTML tables and SVG pictures for notebooks, without other packages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

_WIDTH_PX = 260
_MOST_WINDOWS = 2000


def table(title: str, rows: Mapping[str, str]) -> str:
    """Return a small table as HTML."""
    body = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items()
    )
    return f"<table><caption>{escape(title)}</caption>{body}</table>"


def windows_picture(
    corners: Sequence[Sequence[int]] | NDArray[Any], window: tuple[int, int], frame_shape: tuple[int, int]
) -> str:
    """Return the windows in their frame as SVG; the first row is at the bottom."""
    (height, width), (rows, columns) = frame_shape, window
    windows = "".join(
        f'<rect x="{column}" y="{height - row - rows}" width="{columns}" height="{rows}"/>'
        for row, column in corners[:_MOST_WINDOWS]
    )
    text = f"{len(corners)} sub-apertures of {rows} x {columns} px in a frame of {height} x {width} px"
    if len(corners) > _MOST_WINDOWS:
        text += f" (the first {_MOST_WINDOWS} are drawn)"
    return _picture(
        f'<g fill="#4477aa55" stroke="#4477aa" stroke-width="{max(height, width) / 400:.3g}">{windows}</g>',
        (height, width),
        text,
    )


def image_picture(image: NDArray[np.float64], title: str) -> str:
    """Return a small square image as SVG; the first row is at the bottom."""
    side = len(image)
    relative = np.clip(image / max(float(image.max()), 1e-30), 0.0, 1.0)
    pixels = "".join(
        f'<rect x="{column}" y="{side - 1 - row}" width="1.02" height="1.02" fill-opacity="{value:.2f}"/>'
        for (row, column), value in np.ndenumerate(relative)
        if value >= 0.01
    )
    return _picture(f'<g fill="#4477aa">{pixels}</g>', (side, side), f"{title}, {side} x {side} px of it")


def _picture(content: str, shape: tuple[int, int], text: str) -> str:
    height, width = shape
    tall = round(_WIDTH_PX * height / width)
    return (
        f'<figure><svg viewBox="0 0 {width} {height}" width="{_WIDTH_PX}" height="{tall}" role="img" '
        f'aria-label="{escape(text)}"><rect width="{width}" height="{height}" fill="none" stroke="#888888" '
        f'stroke-width="{max(shape) / 300:.3g}"/>{content}</svg>'
        f"<figcaption>{escape(text)}</figcaption></figure>"
    )
