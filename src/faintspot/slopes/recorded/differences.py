"""Difference of two recordings of the same lenslets, whose layouts may differ."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.flags import INVALID, UNMEASURED, SubapertureFlag, are_valid
from faintspot.io.slopes import subtracted_reference
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.statistics import mean_over_valid
from faintspot.slopes.recorded.stored_run import StoredRun
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_pitch

_SAME_PX = 0.01  # between the lattices of two recordings
_TURNED_DEG, _SCALED = 5.0, 0.15  # largest differences of angle and pitch, which contains defocus
# Least part of the first layout that must be in both, and part of it that another shift may lose.
_LEAST, _SPARE = 0.5, 0.02
# Powers of x and y in slopes of a smooth wavefront. Lenslets are the same ones if their own errors cancel:
# the rest of the difference is then below this part of that for any other shift.
_POWERS, _CANCELLED = [(i, j) for i in range(4) for j in range(4 - i)], 0.7
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
    layout, theirs = _layouts(run, other)
    places, their_places = _places(run, layout), _places(other, theirs)
    matches = _shifted(run, other, layout, theirs)
    rests = [_rest(layout, their_places[match] - places) for match in matches]
    apart = [(theirs.centres[match] - layout.centres)[match >= 0].mean(axis=0) for match in matches]
    best = int(np.argmin(rests))
    is_certain = len(rests) == 1 or rests[best] < _CANCELLED * np.partition(rests, 1)[1]
    best = best if is_certain else int(np.argmin(np.hypot(*np.transpose(apart))))
    match, keep = matches[best], run.keep & other.keep
    own = Slopes.from_variables(run.stored.variables, keep=keep)
    common = {name: values[..., match] for name, values in other.stored.variables.items()}
    common["flags"][..., match < 0] = int(SubapertureFlag.NO_FLUX)
    subtracted = Slopes.from_variables(common, keep=keep)
    offsets = np.nan_to_num(their_places[match] - layout.centres - subtracted_reference(run.stored))
    x, y = (own.x - offsets[:, 0]).astype(np.float32), (own.y - offsets[:, 1]).astype(np.float32)
    lost = [
        np.where(are_valid(each.flags, keep).any(axis=0), 0, np.bitwise_or.reduce(each.flags))
        for each in (own, subtracted)
    ]
    notes = _notes(apart[best], lenslet_pitch(layout), is_certain)
    notes += [note for each in (run, other) if (note := _about_cut_spots(each))]
    subtracted = replace(subtracted, flags=subtracted.flags | lost[0])
    return replace(own, flags=own.flags | lost[1], x=x, y=y), subtracted, notes


def _layouts(run: StoredRun, other: StoredRun) -> tuple[Layout, Layout]:
    if run.layout is None or other.layout is None:
        missing = run if run.layout is None else other
        raise InputError(f"{missing.path}: expected slopes with their layout ({' '.join(missing.notes)})")
    return run.layout, other.layout


def _places(run: StoredRun, layout: Layout) -> Floats:
    """Return the mean place of each spot in the frame, (n, 2); NaN if it is never valid."""
    valid = are_valid(run.stored.variables["flags"], run.keep)
    slopes = [mean_over_valid(run.stored.variables[axis], valid) for axis in "xy"]
    return layout.centres + subtracted_reference(run.stored) + np.stack(slopes, axis=-1)


def _shifted(run: StoredRun, other: StoredRun, layout: Layout, theirs: Layout) -> list[NDArray[np.int64]]:
    """Return the index in the second layout of each lenslet of the first, -1 if it lacks it.

    The lattices may be whole rows and columns apart: one result for each shift with the most common lenslets.
    """
    from scipy.signal import fftconvolve  # slow to import

    own, cells = (each.cells - each.cells.min(axis=0) for each in (layout, theirs))
    lit, index = np.zeros(own.max(axis=0) + 1), np.full(cells.max(axis=0) + 1, -1)
    lit[tuple(own.T)], index[tuple(cells.T)] = 1.0, np.arange(len(cells))
    shared = fftconvolve(index >= 0, lit[::-1, ::-1])
    alike = layout.geometry == theirs.geometry
    alike &= abs((theirs.angle_deg - layout.angle_deg + 180) % 360 - 180) < _TURNED_DEG
    alike &= abs(lenslet_pitch(theirs) / lenslet_pitch(layout) - 1) < _SCALED
    if not alike or shared.max() < _LEAST * len(own):
        raise InputError(
            f"{other.path}: expected the {len(layout)} sub-apertures of {run.path}, or most of them in "
            f"another layout, got {len(theirs)} of others; measure both recordings with the same --config"
        )
    index = np.pad(index, [(side - 1, side - 1) for side in lit.shape], constant_values=-1)
    shifts = np.argwhere(shared > shared.max() - _SPARE * len(own) - 0.5)
    return [index[tuple((own + shift).T)] for shift in shifts]


def _rest(layout: Layout, apart: Floats) -> float:
    """Return the rms of displacements (n, 2) about those of a smooth wavefront; infinite for too few."""
    known = np.isfinite(apart).all(axis=1)
    if np.count_nonzero(known) < 2 * len(_POWERS):
        return np.inf
    x, y = ((layout.centres - layout.centres.mean(axis=0)) / np.ptp(layout.centres, axis=0).max()).T[:, known]
    terms = np.stack([x**i * y**j for i, j in _POWERS], axis=-1)
    rest = apart[known] - terms @ np.linalg.lstsq(terms, apart[known], rcond=None)[0]
    return float(np.sqrt(np.sum(rest**2) / (2 * (len(terms) - len(_POWERS)))))


def _notes(apart_px: Floats, pitch_px: float, is_certain: bool) -> list[str]:
    """Return a note on the distance of the two layouts, if there is one."""
    if np.hypot(*apart_px) < _SAME_PX:
        return []
    doubt = "" if is_certain else "; whole pitches may be missing, as one recording has more lit lenslets"
    return [
        f"The subtracted lattice lies ({apart_px[0]:.2f}, {apart_px[1]:.2f}) px away, "
        f"{np.hypot(*apart_px) / pitch_px:.2f} pitches: this is tilt{doubt}."
    ]


def _about_cut_spots(run: StoredRun) -> str:
    """Return a note on a recording with many spots outside their windows."""
    flags = run.stored.variables["flags"]
    lit = flags & int(UNMEASURED) == 0
    cut = float(np.mean(flags[lit] & int(INVALID) != 0)) if lit.any() else 0.0
    if cut < _CUT:
        return ""
    return (
        f"{cut:.0%} of the spots of {run.path.name} are cut by windows or unlike all neighbours: others may "
        "be wrong, too. Make a layout from its own frames."
    )
