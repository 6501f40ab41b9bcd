"""Picture of a frame whose spots were followed out of their windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import WIDTH, colour_bar, new_figure, styled
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.layout_picture import asinh_stretch
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PATH, _VALID, _INVALID = "#56B4E9", "#E69F00", "#CC79A7"
_MOST_FRAMES = 200  # of which the paths are drawn


@dataclass(frozen=True)
class Followed:
    """Spots of a recording that were followed, and the frame of the picture.

    Attributes
    ----------
    frame : array (h, w)
    number : int
        Its number in the recording.
    slopes : Slopes
        Slopes of all frames [px].
    reference : array (n_subapertures, 2)
        Reference positions, px from the sub-apertures' centres.
    """

    frame: NDArray[Any]
    number: int
    slopes: Slopes
    reference: NDArray[np.float64]

    def largest_pitches(self, layout: Layout) -> float:
        """Return the largest displacement of a valid spot, in pitches."""
        length = np.hypot(self.slopes.x, self.slopes.y)[self.slopes.valid]
        return float(length.max(initial=0.0) / (layout.pitch_px or np.nan))


def farthest_frame(slopes: Slopes) -> int:
    """Return the number of the frame in which the valid spots are displaced most, as rms."""
    squares = np.where(slopes.valid, slopes.x**2 + slopes.y**2, 0.0)
    return int(np.argmax(squares.sum(axis=1) / np.maximum(slopes.valid.sum(axis=1), 1)))


@styled
def followed_picture(followed: Followed, layout: Layout) -> Figure:
    """Draw a frame with an arrow from each reference position to its spot, and the paths of all spots."""
    from matplotlib.collections import LineCollection

    slopes, number = followed.slopes, followed.number
    nodes = layout.centres + followed.reference
    at = nodes + np.stack([slopes.x, slopes.y], axis=-1)
    shown = np.where(slopes.valid[..., None], at, np.nan)
    everything = np.concatenate([nodes, shown.reshape(-1, 2)])
    margin = 0.7 * max(layout.window)
    (left, top), (right, bottom) = (
        np.nanmin(everything, axis=0) - margin,
        np.nanmax(everything, axis=0) + margin,
    )
    figure = new_figure(WIDTH, min(0.9 * WIDTH * (bottom - top) / (right - left) + 0.5, 1.3 * WIDTH))
    axes = figure.subplots()
    frame = np.asarray(followed.frame, np.float64)
    image = axes.imshow(frame, cmap="gray", norm=asinh_stretch(frame, layout.images(frame)))
    colour_bar(axes, image, "frame's units")
    paths = shown[:: -(-len(shown) // _MOST_FRAMES)].transpose(1, 0, 2)
    axes.add_collection(LineCollection(list(paths), colors=_PATH, linewidths=0.7))
    axes.plot(*nodes.T, "+", ms=4, mew=0.8, color="white", label="reference")
    valid, doubtful = slopes.valid[number], slopes.measured[number] & ~slopes.valid[number]
    options: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004, "zorder": 3}
    axes.quiver(*nodes[valid].T, *(at[number] - nodes)[valid].T, color=_VALID, label="valid spot", **options)
    if doubtful.any():
        axes.plot(*at[number][doubtful].T, "o", mfc="none", color=_INVALID, label="crossing or doubtful")
    axes.plot([], [], color=_PATH, label="path over all frames")
    height, width = frame.shape
    axes.set(
        xlim=(max(left, -0.5), min(right, width - 0.5)), ylim=(max(top, -0.5), min(bottom, height - 0.5))
    )
    axes.set(xlabel="column (px)", ylabel="row (px)")
    style = {"facecolor": "#777777", "labelcolor": "white", "edgecolor": "none"}
    figure.legend(loc="outside upper center", ncols=4, **style)
    return figure
