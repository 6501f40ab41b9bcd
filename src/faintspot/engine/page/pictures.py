"""Frames as pictures of one byte per pixel, with the values that black and white represent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.engine.page.batch import Picture
from faintspot.engine.page.messages import packed
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines

_PERCENTILES = (1.0, 99.9)  # shown as black and white, so that one hot pixel does not darken the rest
_MOST_SAMPLES = 1 << 16  # for the percentiles


class FrameDrawing:
    """Pictures of a sensor, and its geometry for the page.

    Parameters
    ----------
    layout : Layout
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        height, width = layout.window
        rows = layout.corners[:, 0, None, None] + np.arange(height)[:, None]
        columns = layout.corners[:, 1, None, None] + np.arange(width)
        self._pixels = np.broadcast_arrays(rows, columns)

    def sensor(self) -> bytes:
        """Return the message with the sensor's geometry: positions in pixels of the frame."""
        layout = self.layout
        values = {"frame_shape": layout.frame_shape, "window": layout.window, "subapertures": len(layout)}
        arrays = {
            "corners": np.asarray(layout.corners, np.float32),
            "centres": np.asarray(layout.centres, np.float32),
            "outlines": lenslet_outlines(layout, 0.96).astype(np.float32),
        }
        return packed("sensor", values, arrays)

    def message(self, picture: Picture, record: NDArray[np.void] | None) -> bytes:
        """Return the message of a frame; without spots if its record is no longer available."""
        raw, raw_range = _in_bytes(picture.raw)
        stack, denoised_range = _in_bytes(picture.denoised)
        denoised = np.zeros(self.layout.frame_shape, np.uint8)
        denoised[tuple(self._pixels)] = np.maximum(stack, 1)  # 0: no sub-aperture
        arrays = {"raw": raw, "denoised": denoised}
        if record is not None:
            arrays |= {name: record[name] for name in ("x", "y", "flags")}
        values = {"frame": picture.frame, "raw_adu": raw_range, "denoised_e": denoised_range}
        return packed("pictures", values, arrays)


def _in_bytes(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return values as bytes, and the values of 0 and 255; values that are not finite become 0."""
    finite = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    samples = finite.ravel()[:: max(1, finite.size // _MOST_SAMPLES)]
    low, high = (float(value) for value in np.percentile(samples, _PERCENTILES))
    if not high > low:
        high = low + 1.0
    scaled = (finite - low) * (255.0 / (high - low))
    return np.clip(scaled, 0, 255).astype(np.uint8), (low, high)
