"""Recordings of loops brought to one convention: sign, rows, unit and offsets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.faults import (
    followers,
    rows_without_measurement,
    silent_subapertures,
    still_actuators,
    stuck_slopes,
)
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import modes_of_turbulence, order_remark

_MOST_SENT_AFTER = 5  # frames
_CLEAR = 0.5  # correlation of an integrator's steps with its slopes, above which their rows are known
_UNRELATED = 0.1  # coherence below which commands are not those of the loop
_WINDOW, _SLOW, _INDEPENDENT = 64, 16, 0.75  # frames; part of them; part of half-overlapping pieces
_IN_PHASE, _MOST_COMPARED = 0.4, 200  # part that tells the sign; slopes
_STEPS_FOR_TEST = 200  # fewest of them
_PIECES = 8  # in which commands are to follow slopes alike
_REGULAR = 0.9  # least part of the gaps between exposures that are whole numbers of exposures
_NAMED = 5  # sub-apertures in a remark
_BROKEN = 1e6  # rms of a slope relative to the median one
_RCOND = 0.05  # of the shape that slopes show
_PARTS, _NOT_ZERO = 16, 3.0  # of a recording; rms of the means of slopes that are not 0, in standard errors
_HELD, _HELD_MODES = 10.0, 0.1  # standard errors of the mean of a mode that is held; part of all modes


class Prepared(NamedTuple):
    """Recording in one convention: commands add to the slopes, and row k is computed from frame k."""

    recording: Recording
    """Slopes and matrix in units of the slopes' rms."""
    sign: float
    """-1 where the commands of the original are subtracted."""
    sent_after_frames: int
    loop_gain: float
    """Gain of the integrator that computed the commands; infinite if another controller did."""
    reference_slopes: Floats
    """(m,): slopes of the original that are 0 here, in `slope_unit`."""
    flat_command: Floats
    """(commands,): command of the original that is 0 here; without commands empty."""


def prepared(recording: Recording) -> Prepared:
    """Bring a recording to one convention of sign, rows, unit and offsets.

    Raises
    ------
    InputError
        When the slopes do not vary, are in another order than the cells, or the commands have nothing to do
        with them.
    """
    recording = _exposures(recording)
    slopes = recording.slopes[np.isfinite(recording.slopes)]
    if not slopes.size:
        raise InputError(f"{recording.name}: expected slopes, got none that were measured")
    if not float(np.ptp(slopes)) > 1e-12 * float(np.abs(slopes).max()):
        raise InputError(f"{recording.name}: expected slopes that vary, got constant ones")
    _check_alike(recording)
    return _in_one_convention(_without_unmeasured(recording))


def _in_one_convention(recording: Recording) -> Prepared:
    """Return what is prepared of slopes that measure something; silent sub-apertures are left out."""
    centred, reference, flat = _about_offsets(recording)
    scaled = centred.scaled(float(np.nanstd(centred.slopes)))
    offsets = recording.unit * reference, flat
    moves = scaled.commands is not None and np.ptp(scaled.commands, axis=0).any()
    if (moves or not scaled.is_closed) and (doubt := order_doubt(scaled)):
        scaled = replace(scaled, remarks=(*scaled.remarks, doubt))
    if not recording.is_closed or recording.commands is None or recording.interaction_matrix is None:
        return Prepared(scaled, 1.0, 0, math.inf, *offsets)
    loop, sign, sent, loop_gain = _with_convention(scaled)
    silent = _silent(loop)
    if silent.any():
        return _in_one_convention(_without_silent(recording, silent, sign))
    return Prepared(_without_still_actuators(loop), sign, sent, loop_gain, *offsets)


def _about_offsets(recording: Recording) -> tuple[Recording, Floats, Floats]:
    """Return a recording less its reference slopes and flat command, and these, with remarks on means.

    An open loop is not about its means, which belong to the wavefront.
    """
    found = {"reference_slopes": _reference(recording), "flat_command": _flat(recording)}
    remarks, values = [], dict[str, Any]()
    for name, of in (("reference_slopes", "slopes"), ("flat_command", "commands")):
        array, stated = getattr(recording, of), getattr(recording, name)
        if stated is not None:
            found[name] = stated
        elif found[name].any():
            rms = float(np.sqrt(np.square(found[name]).mean()))
            remarks.append(f"{name.replace('_', ' ')}: the mean of the {of}, {rms:.3g} rms, is subtracted")
        values |= {name: None, of: None if array is None else array - found[name]}
    centred = replace(recording, remarks=(*recording.remarks, *remarks), **values)
    return centred, found["reference_slopes"], found["flat_command"]


def _reference(loop: Recording) -> Floats:
    """Return the mean of the slopes, (m,), if it is not 0: an integrator leaves none but the reference's."""
    mean, in_errors = _mean(loop.slopes)
    return mean * (loop.is_closed and np.square(in_errors).mean() > _NOT_ZERO**2)


def _flat(loop: Recording) -> Floats:
    """Return the mean of the commands, (commands,), in the modes of the mirror in which they hold a shape.

    Turbulence leaves a mean of few standard errors, a bias one of many in a mode or two, and a shape in many
    modes: then it is taken to be in all.
    """
    if loop.commands is None or loop.interaction_matrix is None or not loop.is_closed:
        return np.zeros(0 if loop.commands is None else loop.commands.shape[1])
    _, modes = np.linalg.eigh(loop.interaction_matrix.T @ loop.interaction_matrix)
    mean, in_errors = _mean(loop.commands @ modes)
    least = 0.0 if (in_errors > _HELD).mean() > _HELD_MODES else _HELD
    return np.asarray(modes @ np.where(in_errors > least, mean, 0.0))


def _mean(values: Floats) -> tuple[Floats, Floats]:
    """Return means of columns, the medians of those of parts, and their size in standard errors."""
    starts = np.linspace(0, len(values), min(_PARTS, len(values)), endpoint=False).astype(int)
    known = np.isfinite(values)
    counts = np.add.reduceat(known.astype(np.int64), starts)
    sums = np.add.reduceat(np.where(known, values, 0.0), starts)
    whole = sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), whole)
    mean, error = np.median(means, axis=0), means.std(axis=0) / math.sqrt(len(starts))
    return mean, np.where(error > 0, np.abs(mean) / np.where(error > 0, error, 1.0), 0.0)


def _exposures(recording: Recording) -> Recording:
    """Return a recording without rows that are no measurements: slopes of 0, or those of an earlier row.

    Where every k-th row alone is one, these are the frames: the sensor integrates over k rows of the loop.
    """
    frame, blank = recording.frame, rows_without_measurement(recording.slopes)
    kept = frame[~blank]
    if not blank.any() or len(kept) < 2:
        return recording
    remark = f"rows: {len(frame) - len(kept)} of {len(frame)} without a measurement: zeros, repeats or NaN"
    gaps = np.diff(kept)
    step = int(np.median(gaps))
    if step == 1 or (gaps % step == 0).mean() < _REGULAR:
        slopes = np.where(blank[:, None], np.nan, recording.slopes)
        return replace(recording, slopes=slopes, remarks=(*recording.remarks, remark))
    rate, delay, sent = recording.frame_rate_hz / step, recording.delay_frames, recording.sent_after_frames
    remark += f"; one row in {step} is an exposure, so a frame is an exposure, at {rate:.6g} Hz"
    return replace(
        recording.part(~blank),
        frame=np.cumsum(np.append(0, np.maximum(np.rint(gaps / step), 1))).astype(np.int64),
        frame_rate_hz=rate,
        delay_frames=None if delay is None else (delay + step - 1) / step,
        sent_after_frames=None if sent is None else math.ceil(sent / step),
        remarks=(*recording.remarks, remark),
    )


def order_doubt(loop: Recording) -> str:
    """Return a remark if cells may be in another order than the slopes; see `order_remark`."""
    matrix = loop.interaction_matrix if loop.is_closed else modes_of_turbulence(loop.slopes)
    if loop.cells is None or matrix is None or not matrix.shape[1]:
        return ""
    return order_remark(matrix, loop.cells, of_turbulence=not loop.is_closed)


def _check_alike(recording: Recording) -> None:
    """Refuse a recording in which some slopes are so much larger than the others that they are broken."""
    measured = np.isfinite(recording.slopes)
    slopes = np.where(measured, recording.slopes, 0.0)
    largest = np.abs(slopes).max(axis=0)
    usual = float(np.median(largest[largest > 0]))
    (broken,) = np.nonzero(largest > _BROKEN * usual)
    if len(broken):
        columns = ", ".join(map(str, broken[:5]))
        raise InputError(
            f"{recording.name}: expected slopes of similar size, got columns {columns} over {_BROKEN:g} "
            "times the median; flag them, or write NaN there"
        )


def _without_unmeasured(recording: Recording) -> Recording:
    """Return the recording without slopes that measure nothing, and with remarks that name them.

    Raises
    ------
    InputError
        When none are left.
    """
    if recording.cells is None:
        return _without_constant(recording)
    n, stuck, matrix = len(recording.cells), stuck_slopes(recording.slopes), recording.interaction_matrix
    slopes = np.where(np.tile(stuck, 2), np.nan, recording.slopes)
    measured = np.isfinite(slopes)
    known = measured.reshape(len(slopes), 2, n).any(axis=(0, 1))
    reasons = {
        "no slope was measured": ~np.isfinite(recording.slopes).reshape(len(slopes), 2, n).any(axis=(0, 1)),
        "slopes are constant or take two or three values": stuck.any(axis=0) & ~known,
        "slopes stick for a part of the time": stuck.any(axis=0) & known,
        "slopes follow each other exactly": followers(slopes),
    }
    if matrix is not None:
        answers = matrix.any(axis=1).reshape(2, n)
        # A mirror may move one axis only.
        silent = ~answers & answers.any(axis=1)[:, None]
        reasons["rows of the interaction matrix are 0"] = silent.any(axis=0)
    remarks = [f"{_named(mask, recording.cells)}: {why}" for why, mask in reasons.items() if mask.any()]
    for why in tuple(reasons)[3:]:
        slopes[:, np.tile(reasons[why], 2)] = np.nan
    if not np.isfinite(slopes).any():
        raise InputError(f"{recording.name}: expected slopes that measure something; {'; '.join(remarks)}")
    return replace(recording, slopes=slopes, remarks=(*recording.remarks, *remarks)) if remarks else recording


def _without_constant(recording: Recording) -> Recording:
    """Return a recording without cells whose constant slopes are NaN, and named in a remark."""
    low, high = (extreme(recording.slopes, axis=0) for extreme in (np.fmin.reduce, np.fmax.reduce))
    constant = np.flatnonzero(~(low < high))
    if not len(constant):
        return recording
    slopes = recording.slopes.copy()
    slopes[:, constant] = np.nan
    remark = f"slope {_first_ones(constant)}: constant, or never measured"
    return replace(recording, slopes=slopes, remarks=(*recording.remarks, remark))


def _without_still_actuators(loop: Recording) -> Recording:
    """Return a recording whose matrix is 0 for commands that slopes do not follow, with a remark."""
    if not loop.is_closed or loop.commands is None or not np.ptp(loop.commands, axis=0).any():
        return loop
    is_still = still_actuators(np.nan_to_num(loop.slopes), loop.commands, loop.interaction_matrix)
    if not is_still.any():
        return loop
    remark = (
        f"command {', '.join(map(str, np.flatnonzero(is_still)))}: slopes do not follow, so it is not used"
    )
    matrix = np.where(is_still, 0.0, loop.interaction_matrix)
    return replace(loop, interaction_matrix=matrix, remarks=(*loop.remarks, remark))


def _silent(loop: Recording) -> NDArray[np.bool_]:
    """Return the sub-apertures that do not see the wavefront, (n,)."""
    if loop.cells is None:
        return np.zeros(0, np.bool_)
    steps = np.diff(loop.commands, axis=0) @ loop.interaction_matrix.T
    steps[np.diff(loop.frame) != 1] = 0.0
    return silent_subapertures(loop.slopes, steps)


def _without_silent(loop: Recording, silent: NDArray[np.bool_], sign: float) -> Recording:
    """Return a recording without silent sub-apertures, about what the mirror holds without them.

    Their mean slopes have driven the mirror to a wrong shape, which the means of the others show.
    """
    slopes = np.where(np.tile(silent, 2), np.nan, loop.slopes)
    named = _named(silent, loop.cells)
    remark = f"{named}: slopes do not answer the mirror, or are no part of what it corrects"
    rest = replace(loop, slopes=slopes, remarks=(*loop.remarks, remark))
    if loop.reference_slopes is not None or not _reference(loop).any():
        return rest
    known = np.isfinite(slopes).any(axis=0)
    wrong = sign * np.linalg.lstsq(loop.interaction_matrix[known], _mean(slopes)[0][known], rcond=_RCOND)[0]
    flat = (
        _flat(replace(loop, commands=loop.commands - wrong))
        if loop.flat_command is None
        else loop.flat_command
    )
    return replace(rest, reference_slopes=np.zeros(slopes.shape[1]), flat_command=flat)


def _named(mask: NDArray[np.bool_], cells: NDArray[np.int64]) -> str:
    """Return sub-apertures with row and column as text."""
    numbers = np.flatnonzero(mask)
    named = [f"{k} (row {cells[k][0]}, column {cells[k][1]})" for k in numbers]
    return f"sub-aperture{'s' if len(numbers) > 1 else ''} {_first_ones(named)}"


def _first_ones(values: Sequence[object] | NDArray[np.int64]) -> str:
    more = f" and {len(values) - _NAMED} more" if len(values) > _NAMED else ""
    return f"{', '.join(map(str, values[:_NAMED]))}{more}"


def _with_convention(loop: Recording) -> tuple[Recording, float, int, float]:
    """Return a closed loop whose commands add, in the rows of the frames that they were computed from.

    Then sign, rows and gain, see `Prepared`.
    """
    if not np.ptp(loop.commands, axis=0).any():
        return loop, 1.0, 0, math.inf
    stated, remarks = loop.sent_after_frames, list(loop.remarks)
    controlled, caused = _controlled(loop)
    correlations, gains = _steps_on_slopes(controlled, caused, loop.frame)
    clearest = int(np.argmax(np.abs(correlations)))
    largest = float(np.abs(correlations[clearest]))
    if len(loop.slopes) > _STEPS_FOR_TEST and largest < _CLEAR:
        coherence, in_phase = _coherence(controlled, caused)
        if coherence < _UNRELATED:
            raise InputError(
                f"commands: expected commands computed from the slopes, got a coherence of {coherence:.2f} "
                "with them; check that both are of one loop and the interaction matrix is its own"
            )
        if abs(in_phase) < _IN_PHASE and loop.command_sign is None:
            raise InputError(
                "commands: their sign cannot be known from the slopes; state command_sign, 1 where commands "
                "add to the slopes, -1 where they are subtracted"
            )
        correlations = np.full_like(correlations, in_phase)
    sent = stated if stated is not None else clearest if largest >= _CLEAR else 0
    if stated is None and sent:
        remarks.append(f"commands: computed {sent} frames before the row in which they are recorded")
    if stated is not None and largest >= _CLEAR and clearest != stated:
        remarks.append(f"sent_after_frames is {stated}, but the commands follow the slopes after {clearest}")
    loop_gain = abs(float(gains[min(sent, _MOST_SENT_AFTER)]))
    sign = loop.command_sign or (-1.0 if correlations[min(sent, _MOST_SENT_AFTER)] > 0 else 1.0)
    if sign < 0:
        remarks.append("commands: sign reversed, as they are subtracted from the turbulence")
    rows = np.searchsorted(loop.frame, loop.frame + sent)
    usable = rows < len(loop.frame)
    usable[usable] = loop.frame[rows[usable]] == loop.frame[usable] + sent
    moved = replace(
        loop.part(usable),
        commands=sign * loop.commands[rows[usable]],
        remarks=tuple(remarks),
        sent_after_frames=0,
    )
    return moved, sign, sent, loop_gain if largest >= _CLEAR else math.inf


def _controlled(loop: Recording) -> tuple[Floats, Floats]:
    """Return the part of the slopes that commands can correct, and the slopes of these, without means."""
    reconstructor = make_reconstructor(loop.interaction_matrix)
    controlled = np.nan_to_num(loop.slopes) @ reconstructor.matrix.T @ loop.interaction_matrix.T
    caused = loop.commands @ loop.interaction_matrix.T
    return controlled - controlled.mean(axis=0), caused - caused.mean(axis=0)


def _coherence(controlled: Floats, caused: Floats) -> tuple[float, float]:
    """Return the coherence of slopes and commands beyond chance, and what part of it is in phase.

    The latter is of slow changes, before delays matter: negative where commands oppose the slopes.
    """
    moving = np.flatnonzero(controlled.any(axis=0) & caused.any(axis=0))[:_MOST_COMPARED]
    one, other = controlled[1:, moving].T, np.diff(caused[:, moving], axis=0).T
    pieces = max(2, 2 * one.shape[1] // _WINDOW - 1)
    crossed = scipy.signal.csd(one, other, nperseg=_WINDOW)[1][:, 1:]
    power = (
        scipy.signal.welch(one, nperseg=_WINDOW)[1][:, 1:]
        * scipy.signal.welch(other, nperseg=_WINDOW)[1][:, 1:]
    )
    coherency = crossed / np.sqrt(np.maximum(power, 1e-300))
    slow = coherency[:, : _WINDOW // _SLOW]
    in_phase = float(slow.real.sum() / max(float(np.abs(slow).sum()), 1e-300))
    return float(np.square(np.abs(coherency)).mean()) - 1 / (_INDEPENDENT * pieces), in_phase


def _steps_on_slopes(
    controlled: Floats, caused: Floats, frame: NDArray[np.int64], most_lag: int = _MOST_SENT_AFTER
) -> tuple[Floats, Floats]:
    """Return correlations of slopes with steps of the commands 0, 1, ... rows later, and regressions.

    Steps are regressed on the command before, too, as a leak takes a part of it.
    """
    before = np.vstack([caused[:1], caused[:-1]])
    steps = caused - before
    is_first = np.diff(frame, prepend=frame[0] - 1) != 1
    steps[is_first] = before[is_first] = 0.0
    correlations, regressions = [], []
    for lag in range(most_lag + 1):
        one, other, held = controlled[: len(controlled) - lag], steps[lag:], before[lag:]
        sizes = math.sqrt(float((one * one).sum()) * float((other * other).sum()))
        correlations.append(float((one * other).sum()) / max(sizes, 1e-300))
        both = np.stack([one.ravel(), held.ravel()])
        regressions.append(float((np.linalg.pinv(both @ both.T) @ (both @ other.ravel()))[0]))
    return np.array(correlations), np.array(regressions)


def gains_of_pieces(loop: Recording) -> Floats:
    """Return how commands follow slopes in pieces of a prepared recording, in the usual gain, (pieces, axes).

    Axes are x and y, or all slopes without cells. An integrator follows alike in all; no pieces where the
    commands are not those of an integrator.
    """
    loop = loop.part(np.isfinite(loop.slopes).any(axis=1))
    axes = np.array_split(np.arange(loop.slopes.shape[1]), 1 if loop.cells is None else 2)
    if len(loop.frame) < _PIECES * _WINDOW:
        return np.zeros((0, len(axes)))
    controlled, caused = _controlled(loop)
    gains, correlations = [], []
    for rows in np.array_split(np.arange(len(loop.frame)), _PIECES):
        for columns in axes:
            part = np.ix_(rows, columns)
            correlation, gain = _steps_on_slopes(controlled[part], caused[part], loop.frame[rows], 0)
            correlations.append(abs(float(correlation[0])))
            gains.append(float(gain[0]))
    usual = float(np.median(gains))
    if np.median(correlations) < _CLEAR or not usual:
        return np.zeros((0, len(axes)))
    return np.reshape(gains, (_PIECES, len(axes))) / usual
