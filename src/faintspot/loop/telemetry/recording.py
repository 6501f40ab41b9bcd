"""Learning from telemetry recorded by a running engine, without knowledge of the atmosphere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.io.telemetry import CLOSED_LOOP
from faintspot.loop.control.base import INTEGRATOR, KALMAN, split_control
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.identification.open_loop import FEWEST_FRAMES, freed_of_prior
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.options import NONE, STREAM
from faintspot.loop.slope_covariance import SlopeTurbulence
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import side_m

if TYPE_CHECKING:
    from faintspot.io.telemetry import Telemetry


def recorded_loop(
    recording: Telemetry, control: Control, layout: Layout, prior_std_px: Floats | None = None
) -> Recording:
    """Return the frames of an engine's recording in which the loop was closed with this control.

    Slopes are divided by the configured centroid gain, and freed of the estimator's prior.

    Parameters
    ----------
    recording : faintspot.io.Telemetry
    control : Control
        Source of matrix, delay, centroid gain, and of whether predictions were used.
    layout : Layout
    prior_std_px : (2 n,) array, optional
        Width of the estimator's prior. Default: it had none.

    Raises
    ------
    InputError
        When there are no commands, as many as the control has, no standard errors, or too few frames; and
        where the estimator had a prior around what is not known any more.
    """
    found, options = recording.commands.shape[1], control.options
    if found != control.commands:
        raise InputError(
            f"recording: expected {control.commands} commands, as the interaction matrix has, got {found}"
        )
    predicted = prior_std_px is not None and control.prediction != NONE
    unknown = options.controller != INTEGRATOR or control.prediction == STREAM
    methods = map(str, recording.attributes.get("methods", []))
    in_turn = any(split_control(method)[1] == KALMAN for method in methods)
    if (predicted and unknown) or (prior_std_px is not None and in_turn):
        raise InputError(
            "recording: expected a loop closed with an integrator, as the prior that another controller or "
            "program sent to the estimator was not recorded"
        )
    rows, frame = np.asarray(recording.loop) == CLOSED_LOOP, np.asarray(recording.frame)
    if np.count_nonzero(rows) < FEWEST_FRAMES + options.delay_frames:
        raise InputError(
            f"recording: expected {FEWEST_FRAMES + options.delay_frames} frames with a closed loop, got "
            f"{np.count_nonzero(rows)}"
        )
    invalid = ~np.tile(recording.valid[rows], 2)
    errors = np.hstack([recording.standard_error_x[rows], recording.standard_error_y[rows]])
    errors = np.where(invalid, np.inf, errors) / options.centroid_gain
    if not np.isfinite(errors).any():
        raise InputError("recording: expected standard errors of slopes; give the calibration a read noise")
    times, frames = recording.last_row_time_ns[rows], frame[rows]
    loop = Recording(
        recording.slopes[rows].astype(np.float64) / options.centroid_gain,
        recording.commands[rows],
        control.interaction,
        layout.cells,
        float(frames[-1] - frames[0]) / max(float(times[-1] - times[0]) / 1e9, 1e-9),
        subaperture_m=side_m(layout.cells, layout.subaperture_m, layout.diameter_m, recording.flags[rows]),
        pixel_scale_arcsec=layout.pixel_scale_arcsec,
        delay_frames=options.delay_frames,
        frame=frames,
        standard_errors=errors,
        covariance_xy=recording.covariance_xy[rows].astype(np.float64) / options.centroid_gain**2,
        prior_std=prior_std_px,
        slope_unit="px",
    )
    return freed_of_prior(loop, is_predicted=predicted)


def site_of(layout: Layout) -> SlopeTurbulence:
    """Return prior knowledge of slopes in turbulence: geometry and outer scale.

    Raises
    ------
    InputError
        When the layout does not know the size of a sub-aperture.
    """
    side = side_m(layout.cells, layout.subaperture_m, layout.diameter_m)
    if side is None:
        raise InputError(
            "layout: expected subaperture_m or diameter_m, which say how fast the wind crosses a sub-aperture"
        )
    return SlopeTurbulence.unmeasured(layout.cells, side, layout.pixel_scale_arcsec or 1.0)
