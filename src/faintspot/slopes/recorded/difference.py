"""Difference of two recordings of the same lenslets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.validity import are_valid
from faintspot.io.references import subtracted_reference
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.statistics import mean_over_valid
from faintspot.slopes.recorded.stored_run import StoredRun
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_pitch


def difference(run: StoredRun, other: StoredRun) -> tuple[Slopes, Slopes]:
    """Return the slopes of a run minus the mean positions of another, and the other's own.

    Positions in the frame are compared, so that the runs may have other references. Sub-apertures count
    where both runs have valid slopes.

    Raises
    ------
    InputError
        If the layouts have other sub-apertures.
    """
    layout, theirs = _same_lenslets(run, other)
    keep = run.keep & other.keep
    own, subtracted = (Slopes.from_variables(each.stored.variables, keep=keep) for each in (run, other))
    offsets = theirs.centres + subtracted_reference(other.stored)
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
    common = replace(subtracted, flags=subtracted.flags | lost[0])
    return replace(own, flags=own.flags | lost[1], **moved), common


def _same_lenslets(run: StoredRun, other: StoredRun) -> tuple[Layout, Layout]:
    """Return both layouts, of the same lenslets in the same order."""
    layout, theirs = run.layout, other.layout
    if layout is None or theirs is None:
        missing = run if layout is None else other
        raise InputError(f"{missing.path}: expected slopes with their layout ({' '.join(missing.notes)})")
    same = np.array_equal(layout.cells, theirs.cells) and layout.geometry == theirs.geometry
    if not same or np.abs(layout.centres - theirs.centres).max() > 0.5 * lenslet_pitch(layout):
        raise InputError(
            f"{other.path}: expected the {len(layout)} sub-apertures of {run.path}, at the same places, "
            f"got {len(theirs)} of another layout; measure both recordings with the same --config"
        )
    return layout, theirs
