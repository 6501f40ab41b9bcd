"""Pseudo-open-loop slopes from the telemetry of a closed loop, and their Fried parameter."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.ao_loop.configuration import LoopConfiguration
from faintspot.ao_loop.record import LoopRecord
from faintspot.base.checks import finite_array, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.turbulence.seeing import Seeing, estimate_r0

Floats = NDArray[np.float64]

_LEAST_ILLUMINATION = 0.85  # the theory is that of whole squares


def pseudo_open_loop_slopes(
    slopes_px: ArrayLike,
    commands: ArrayLike,
    interaction_matrix: ArrayLike,
    *,
    centroid_gain: ArrayLike = 1.0,
    delay_frames: int = 0,
) -> Floats:
    """Return open-loop slopes: residual slopes plus the slopes of the mirror during their frame.

    Parameters
    ----------
    slopes_px : (frames, 2 n) array
        Residual slopes from the reference, as measured.
    commands : (frames, m) array
        With `delay_frames` 0: what the mirror held during each frame; else the command computed from it.
    interaction_matrix : (2 n, m) array
        Slopes in px that a unit of each command adds, at a centroid gain of 1.
    centroid_gain : number or (frames,) array
        Slope measured for a displacement of 1 px.
    delay_frames : int
        The command computed from frame k acts first during frame k + delay_frames.

    Returns
    -------
    (frames - delay_frames, 2 n) array
        The first frames, whose mirror is not known, are left out.

    Raises
    ------
    InputError
        When shapes do not fit together, for a negative delay, or a gain that is not above 0.
    """
    slopes = _table("slopes_px", slopes_px)
    held = _table("commands", commands)
    matrix = _table("interaction_matrix", interaction_matrix)
    frames = len(slopes)
    if len(held) != frames:
        raise InputError(f"commands: expected {frames} frames, as in slopes_px, got {len(held)}")
    if matrix.shape != (slopes.shape[1], held.shape[1]):
        raise InputError(
            f"interaction_matrix: expected shape {(slopes.shape[1], held.shape[1])} for these slopes and "
            f"commands, got {matrix.shape}"
        )
    delay = int(number_between("delay_frames", delay_frames, 0, frames - 1, integer=True))
    gain = numbers_between("centroid_gain", centroid_gain, 0, low_open=True)
    if gain.shape not in ((), (frames,)):
        raise InputError(f"centroid_gain: expected one number or {frames}, got shape {gain.shape}")
    divisor = np.broadcast_to(gain, (frames,))[delay:, None]
    result: Floats = slopes[delay:] / divisor - held[: frames - delay] @ matrix.T
    return result


def open_loop_slopes(record: LoopRecord) -> Floats:
    """Return the slopes of the turbulence alone that a run saw, (frames, 2 n) px.

    A run in open loop has measured just them; only the centroid gain is taken out.
    """
    gain = record.centroid_gain[record.method]
    if not record.closed:
        measured: Floats = record.slopes_px / gain[:, None]
        return measured
    return pseudo_open_loop_slopes(
        record.slopes_px, record.commands, record.interaction_matrix, centroid_gain=gain
    )


def r0_of_record(record: LoopRecord, frames: ArrayLike, *, remove_tip_tilt: bool = True) -> Seeing:
    """Return r0 from a run's frames, chosen by a mask, with the run's own outer scale; see `estimate_r0`.

    Only sub-apertures that are at least 85 % illuminated are used; if there are none, all are.

    Raises
    ------
    InputError
        When there are fewer than 20 frames.
    """
    configuration = LoopConfiguration.from_text(record.configuration)
    chosen = np.flatnonzero(np.asarray(frames))
    usable = record.illumination >= _LEAST_ILLUMINATION
    if not usable.any():
        usable = np.ones_like(usable)
    gaps = np.cumsum(np.diff(chosen, prepend=chosen[:1]) > 1)
    slopes = open_loop_slopes(record)[:, np.tile(usable, 2)]
    return estimate_r0(
        slopes[chosen],
        cells=record.cells[usable],
        subaperture_m=record.subaperture_m,
        pixel_scale_rad=record.pixel_scale_rad,
        outer_scale_m=configuration.atmosphere.outer_scale_m,
        baseline_m=record.subaperture_m * (1 - 1 / configuration.sensor.samples),
        segment=gaps,
        static_px=slopes[record.scored].mean(axis=0),
        remove_tip_tilt=remove_tip_tilt,
    )


def _table(name: str, value: ArrayLike) -> Floats:
    array = finite_array(name, value)
    if array.ndim != 2:
        raise InputError(f"{name}: expected two axes, got shape {array.shape}")
    return array.astype(np.float64)
