"""Difference of two recordings of the same lenslets, whose layouts may differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from faintspot.base.errors import InputError
from faintspot.base.flags import INVALID, UNMEASURED, SubapertureFlag, are_valid
from faintspot.io.slopes import subtracted_reference
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.statistics import mean_over_valid
from faintspot.slopes.recorded.stored_run import StoredRun
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_pitch

_SAME_PX = 0.01  # between the centres of two layouts
_TURNED_DEG, _SCALED = 5.0, 0.15  # largest differences of angle and pitch, which contains defocus
# Least part of the first layout that must be in both, and part of it that a smaller shift may lose.
_LEAST, _SPARE = 0.5, 0.02
_CUT = 0.1  # part of the spots that are cut by windows from which others are likely to be so, too


def difference(run: StoredRun, other: StoredRun) -> tuple[Slopes, Slopes, list[str]]:
    """Return the slopes of a run minus the mean positions of another, the other's own, and notes.

    Positions in the frame are compared, so that the runs may have other references, and other layouts of the
    same lenslets. Sub-apertures count where both runs have valid slopes.

    Raises
    ------
    InputError
        If the layouts are not of the same lenslets.
    """
    layout, theirs, match = _same_lenslets(run, other)
    keep = run.keep & other.keep
    own = Slopes.from_variables(run.stored.variables, keep=keep)
    common = {name: values[..., match] for name, values in other.stored.variables.items()}
    common["flags"][..., match < 0] = int(SubapertureFlag.NO_FLUX)
    subtracted = Slopes.from_variables(common, keep=keep)
    offsets = (theirs.centres + subtracted_reference(other.stored))[match]
    offsets -= layout.centres + subtracted_reference(run.stored)
    valid = are_valid(subtracted.flags, keep)
    moved = {}
    for axis, offset in zip("xy", offsets.T, strict=True):
        mean = np.nan_to_num(mean_over_valid(getattr(subtracted, axis), valid))
        moved[axis] = (getattr(own, axis) - mean - offset).astype(np.float32)
    lost = [
        np.where(are_valid(each.flags, keep).any(axis=0), 0, np.bitwise_or.reduce(each.flags))
        for each in (own, subtracted)
    ]
    apart = (theirs.centres[match] - layout.centres)[match >= 0].mean(axis=0)
    notes = _notes((run, other), apart, lenslet_pitch(layout))
    subtracted = replace(subtracted, flags=subtracted.flags | lost[0])
    return replace(own, flags=own.flags | lost[1], **moved), subtracted, notes


def _notes(runs: tuple[StoredRun, StoredRun], apart: NDArray[np.float64], pitch_px: float) -> list[str]:
    """Return notes on the distance of the two layouts, and on recordings with spots outside their windows."""
    notes = []
    if np.hypot(*apart) > _SAME_PX:
        pitches = np.hypot(*apart) / pitch_px
        notes.append(
            f"The subtracted lattice lies ({apart[0]:.2f}, {apart[1]:.2f}) px away, {pitches:.2f} pitches: "
            "this is tilt. Whole pitches cannot be told if one of the recordings has more lit lenslets."
        )
    for run in runs:
        flags = run.stored.variables["flags"]
        lit = flags & int(UNMEASURED) == 0
        cut = float(np.mean(flags[lit] & int(INVALID) != 0)) if lit.any() else 0.0
        if cut > _CUT:
            notes.append(
                f"{cut:.0%} of the spots of {run.path.name} are cut by windows or unlike all neighbours: "
                "others may be wrong, too. Make a layout from its own frames."
            )
    return notes


def _same_lenslets(run: StoredRun, other: StoredRun) -> tuple[Layout, Layout, NDArray[np.int64]]:
    """Return both layouts, and the index in the second of each lenslet of the first; -1 if it lacks it.

    The lattices are whole rows and columns apart: by the smallest shift with nearly the most common lenslets.
    """
    layout, theirs = run.layout, other.layout
    if layout is None or theirs is None:
        missing = run if layout is None else other
        raise InputError(f"{missing.path}: expected slopes with their layout ({' '.join(missing.notes)})")
    own, cells = (each.cells - each.cells.min(axis=0) for each in (layout, theirs))
    lit, index = np.zeros(own.max(axis=0) + 1), np.full(cells.max(axis=0) + 1, -1)
    lit[tuple(own.T)], index[tuple(cells.T)] = 1.0, np.arange(len(cells))
    shared = fftconvolve(index >= 0, lit[::-1, ::-1])
    turned = abs((theirs.angle_deg - layout.angle_deg + 180) % 360 - 180)
    scaled = abs(lenslet_pitch(theirs) / lenslet_pitch(layout) - 1)
    alike = layout.geometry == theirs.geometry and turned < _TURNED_DEG and scaled < _SCALED
    if not alike or shared.max() < _LEAST * len(own):
        raise InputError(
            f"{other.path}: expected the {len(layout)} sub-apertures of {run.path}, or most of them in "
            f"another layout, got {len(theirs)} of others; measure both recordings with the same --config"
        )
    index = np.pad(index, [(side - 1, side - 1) for side in lit.shape], constant_values=-1)
    shifts = np.argwhere(shared > shared.max() - _SPARE * len(own) - 0.5)
    matches = [index[tuple((own + shift).T)] for shift in shifts]
    apart = [(theirs.centres[match] - layout.centres)[match >= 0].mean(axis=0) for match in matches]
    return layout, theirs, matches[int(np.argmin(np.hypot(*np.transpose(apart))))]
