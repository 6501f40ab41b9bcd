"""Learning from telemetry recorded by a running engine, without knowledge of the atmosphere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.loop.control.configuration import NONE, STREAM, Control
from faintspot.loop.control.identification.model import INTEGRATOR, KALMAN, MODAL
from faintspot.loop.control.telemetry import OpenLoopTelemetry, make_telemetry
from faintspot.loop.turbulence.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.loop.turbulence.strength import OUTER_SCALE_M
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import side_m

if TYPE_CHECKING:
    from faintspot.io.telemetry.recording import Telemetry as Recording

Floats = NDArray[np.float64]

FEWEST_FRAMES = 200
CLOSED = 2
"""State of a closed loop in telemetry."""


def telemetry_of_recording(
    recording: Recording, control: Control, prior_std_px: Floats | None = None
) -> tuple[OpenLoopTelemetry, float]:
    """Return open-loop slopes of the longest stretch of a recording without a gap, and its frame rate.

    The loop must have been closed with this control.

    Parameters
    ----------
    recording : faintspot.io.Telemetry
    control : Control
        Source of matrix, delay, centroid gain, and of whether predictions were used.
    prior_std_px : (2 n,) array, optional
        How wide the estimator's prior was. Default: it had none.

    Returns
    -------
    Telemetry, float
        The latter in frames a second.

    Raises
    ------
    InputError
        When there are no commands, as many as the control has, or no stretch that is long enough; and where
        the estimator had a prior around what is not known any more.
    """
    found = recording.commands.shape[1]
    if found != control.commands:
        raise InputError(
            f"recording: expected {control.commands} commands, as the interaction matrix has, got {found}"
        )
    predicted = prior_std_px is not None and control.prediction != NONE
    unknown = control.options.controller not in (INTEGRATOR, MODAL) or control.prediction == STREAM
    in_turn = any(str(method).endswith(f"+{KALMAN}") for method in recording.attributes.get("methods", []))
    if (predicted and unknown) or (prior_std_px is not None and in_turn):
        raise InputError(
            "recording: expected a loop closed with an integrator, as the prior that another controller or "
            "program sent to the estimator was not recorded"
        )
    start, stop = _longest(np.asarray(recording.frame), np.asarray(recording.loop) == CLOSED)
    delay = control.options.delay_frames
    if stop - start < FEWEST_FRAMES + delay:
        raise InputError(
            f"recording: expected {FEWEST_FRAMES + delay} frames in a row with a closed loop, got "
            f"{stop - start}"
        )
    rows = np.arange(start + delay, stop)
    slopes, error, mirror, expected = _recorded_slopes(recording, control, rows, predicted)
    times = recording.last_row_time_ns[start:stop]
    rate = (stop - start - 1) / max(float(times[-1] - times[0]) / 1e9, 1e-9)
    covariance = recording.covariance_xy[rows].astype(np.float64) / control.options.centroid_gain**2
    return make_telemetry(slopes, error, mirror, expected, prior_std_px, covariance), rate


def _recorded_slopes(
    recording: Recording, control: Control, rows: NDArray[np.int64], predicted: bool
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return slopes, their errors, the slopes of the mirror, and an integrator's predicted slopes.

    Parameters
    ----------
    recording : faintspot.io.Telemetry
    control : Control
        Whose matrix, delay and centroid gain count.
    rows : (frames,) array
        Of the recording; as many frames as the delay before each must be there.
    predicted : bool
        Whether the estimator had the prediction as its prior; else 0.

    Returns
    -------
    slopes, errors, mirror, expected : (frames, m) arrays
        In true pixels; infinite error: not measured.

    Raises
    ------
    InputError
        When no slope has a standard error.
    """
    gain, delay = control.options.centroid_gain, control.options.delay_frames
    invalid = ~np.tile(recording.valid[rows], 2)
    error = np.hstack([recording.standard_error_x[rows], recording.standard_error_y[rows]]).astype(np.float64)
    error[invalid] = np.inf
    if not np.isfinite(error).any():
        raise InputError("recording: expected standard errors of slopes; give the calibration a read noise")
    slopes = recording.slopes[rows].astype(np.float64) / gain
    mirror, latest = (
        recording.commands[rows - lag].astype(np.float64) @ control.interaction.T for lag in (delay, 1)
    )
    expected = mirror - latest if predicted else np.zeros_like(mirror)  # what acts less the latest command
    return slopes, error / gain, mirror, expected


def site_of(layout: Layout, layers: Sequence[tuple[float, float, float]] = ()) -> SlopeTurbulence:
    """Return prior knowledge of slopes in turbulence: geometry, outer scale, winds.

    Parameters
    ----------
    layout : Layout
    layers : sequence of (float, float, float)
        Speed in m/s, direction in degrees from +x (along columns) to +y (along rows), and strength of each,
        where they are known, of which only the ratios count.

    Raises
    ------
    InputError
        When the layout does not know the size of a sub-aperture, or a value is out of range.
    """
    side = side_m(layout.cells, layout.subaperture_m, layout.diameter_m)
    if side is None:
        raise InputError(
            "layout: expected subaperture_m or diameter_m, which say how fast the wind crosses a sub-aperture"
        )
    positions = layout.cells[:, ::-1].astype(np.float64) * side
    scale = (layout.pixel_scale_arcsec or 1.0) * ARCSEC
    speed, direction, share = np.asarray(layers or [(0.0, 0.0, 1.0)], np.float64).reshape(-1, 3).T
    numbers_between("layers: speed", speed, 0, 200)
    numbers_between("layers: direction", direction, -360, 360)
    numbers_between("layers: strength", share, 0, 1e6, low_open=True)
    winds = speed * np.array([np.cos(np.deg2rad(direction)), np.sin(np.deg2rad(direction))])
    return SlopeTurbulence(positions, side, scale, 0.15, OUTER_SCALE_M, share, winds.T)


def _longest(frame: NDArray[np.int64], closed: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the bounds of the longest run of consecutive frames with a closed loop."""
    if not len(frame):
        return 0, 0
    ends = np.flatnonzero((np.diff(frame) != 1) | (np.diff(closed.astype(np.int8)) != 0)) + 1
    edges = np.concatenate([[0], ends, [len(frame)]])
    lengths = np.diff(edges) * closed[edges[:-1]]
    longest = int(np.argmax(lengths))
    return int(edges[longest]), int(edges[longest]) + int(lengths[longest])
