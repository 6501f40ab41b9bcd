"""Layouts in the camera's pixels, and in those of binned frames."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.sensor.layout import Layout


def binned_layout(layout: Layout) -> Layout:
    """Return the layout in the pixels of binned frames, with bin = 1."""
    if layout.bin == 1:
        return layout
    height, width = layout.frame_shape
    return _scaled(layout, 1 / layout.bin, frame_shape=(height // layout.bin, width // layout.bin), bin=1)


def magnified_layout(layout: Layout, factor: int, frame_shape: tuple[int, int]) -> Layout:
    """Return a layout found in a binned frame in the pixels of the camera, of frames of `frame_shape`."""
    return _scaled(layout, factor, frame_shape=frame_shape, bin=factor)


def scaled_points(points: object, scale: float) -> NDArray[np.float64]:
    """Return points in pixels of another size; pixel i is centred at i."""
    return np.asarray((np.asarray(points, np.float64) + 0.5) * scale - 0.5)


def _scaled(layout: Layout, scale: float, **changes: Any) -> Layout:
    arcsec = layout.pixel_scale_arcsec
    return replace(
        layout,
        window=(round(layout.window[0] * scale), round(layout.window[1] * scale)),
        corners=np.rint(layout.corners * scale).astype(np.int64),
        centres=scaled_points(layout.centres, scale),
        pitch_px=None if layout.pitch_px is None else layout.pitch_px * scale,
        pixel_scale_arcsec=None if arcsec is None else arcsec / scale,
        **changes,
    )
