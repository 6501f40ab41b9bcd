"""What notebooks show of slopes, layouts and PSFs: small tables and pictures, without any other package."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from faintspot.pipeline.slopes import Slopes
    from faintspot.sensor.layout import Layout
    from faintspot.spots.psf import PSF

_WIDTH_PX = 260
_MOST_WINDOWS = 2000


def slopes_in_words(slopes: Slopes) -> dict[str, str]:
    """Return what one wants to know of slopes first, by name."""
    valid = slopes.valid
    n_frames = 1 if slopes.x.ndim == 1 else len(slopes.x)
    found = {
        "frames": f"{n_frames}",
        "sub-apertures": f"{slopes.x.shape[-1]}",
        "valid": f"{100 * float(np.mean(valid)):.4g} %" if valid.size else "none",
    }
    if valid.any():
        x, y, flux = (values[valid].astype(np.float64) for values in (slopes.x, slopes.y, slopes.flux))
        found["rms of x, y"] = f"{np.sqrt(np.mean(x**2)):.3g}, {np.sqrt(np.mean(y**2)):.3g} px"
        found["median flux"] = f"{np.median(flux):.4g} e-"
    return found


def table(title: str, rows: Mapping[str, str]) -> str:
    """Return a small table as HTML."""
    body = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items()
    )
    return f"<table><caption>{escape(title)}</caption>{body}</table>"


def layout_picture(layout: Layout) -> str:
    """Return the windows in their frame, as SVG; the first row is below, as in all pictures."""
    height, width = layout.frame_shape
    rows, columns = layout.window
    windows = "".join(
        f'<rect x="{column}" y="{height - row - rows}" width="{columns}" height="{rows}"/>'
        for row, column in layout.corners[:_MOST_WINDOWS]
    )
    text = f"{len(layout)} sub-apertures of {rows} x {columns} px in a frame of {height} x {width} px"
    if len(layout) > _MOST_WINDOWS:
        text += f" (the first {_MOST_WINDOWS} are drawn)"
    return _picture(
        f'<g fill="#4477aa55" stroke="#4477aa" stroke-width="{max(height, width) / 400:.3g}">{windows}</g>',
        (height, width),
        text,
    )


def psf_picture(psf: PSF) -> str:
    """Return the first PSF, sampled by pixels, as SVG."""
    side = min(max(psf.samples.shape[1:]) // psf.oversampling, 22) - 1 | 1  # odd
    image = psf.images([[0.0, 0.0]], (side, side), 1.0)[0]
    light = np.clip(image / max(float(image.max()), 1e-30), 0.0, 1.0)
    pixels = "".join(
        f'<rect x="{column}" y="{side - 1 - row}" width="1.02" height="1.02" fill-opacity="{value:.2f}"/>'
        for (row, column), value in np.ndenumerate(light)
        if value >= 0.01
    )
    return _picture(f'<g fill="#4477aa">{pixels}</g>', (side, side), f"{psf!r}, {side} x {side} px of it")


def _picture(content: str, shape: tuple[int, int], text: str) -> str:
    height, width = shape
    tall = round(_WIDTH_PX * height / width)
    return (
        f'<figure><svg viewBox="0 0 {width} {height}" width="{_WIDTH_PX}" height="{tall}" role="img" '
        f'aria-label="{escape(text)}"><rect width="{width}" height="{height}" fill="none" stroke="#888888" '
        f'stroke-width="{max(shape) / 300:.3g}"/>{content}</svg>'
        f"<figcaption>{escape(text)}</figcaption></figure>"
    )
