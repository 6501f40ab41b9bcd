"""Sub-apertures in the pupil of the telescope: their outlines, and the circle around them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.flags import UNMEASURED, SubapertureFlag
from faintspot.slopes.sensor.layout import Layout

_DISK_CORNERS = 256
_WHOLE = 1.0  # misfit, in lenslets, that a disk around whole lenslets may have more than the best one
# Part of the lenslets at the edge that are lit in part, by 0.2 to 0.8, if it cuts them: at random, 0.4 are.
_PARTLY, _CUT = 0.3, 0.15
_FULL = 0.7  # quantile of the flux of illuminated sub-apertures that is that of a whole one
_MOST_UNLIT = 2.5  # sub-apertures of a stated diameter, cut by its edge on both sides


@dataclass(frozen=True)
class Pupil:
    """Disk of the telescope pupil in the frame."""

    centre_px: tuple[float, float]
    """Centre x, y in the frame [px]."""
    radius_px: float
    """Radius in the frame [px]; neighbouring lenslets are one pitch of the layout apart."""
    radius_subapertures: float
    """Radius in sub-aperture sides."""
    radius_m: float | None
    """Radius in the entrance pupil; None if the layout does not give its size."""
    error_subapertures: float
    """Standard error of the radius, from how well the disk describes the flux of the sub-apertures."""
    cuts: bool = False
    """Whether it is known where its edge cuts sub-apertures: from two lengths of the layout, or the flux."""
    part: bool = False
    """Whether the layout has sub-apertures without flux, or with flux outside, which the disk does not count.
    """


def pupil_of(layout: Layout, flags: NDArray[Any] | None = None, flux: NDArray[Any] | None = None) -> Pupil:
    """Return the disk of the pupil.

    Centre and radius minimise the absolute differences between the flux of the sub-apertures and their area
    in the disk, so that single ones outside do not count. If the rectangle along the rows of the lattice that
    contains all illuminated sub-apertures in that disk describes the flux as well, its centre and longer side
    are those of the disk, also for square arrays, whose corners are outside. If both `subaperture_m` and
    `diameter_m` are given, the diameter is their ratio.

    Parameters
    ----------
    layout : Layout
    flags, flux : (n,) or (n_frames, n) array, optional
        Flags and flux of slopes. Default: all sub-apertures of the layout have the same flux.

    Raises
    ------
    InputError
        If these two give a disk outside which an illuminated part of the pupil lies, or one that this does
        not fill.
    """
    lit = np.ones(len(layout), np.bool_) if flags is None else lit_subapertures(flags)
    light = lit.astype(np.float64)
    if flags is not None and flux is not None:
        seen = lit * np.where(flags & int(UNMEASURED), 0.0, flux).reshape(-1, len(layout)).mean(axis=0)
        full = float(np.quantile(seen[lit], _FULL))
        light = np.clip(seen / full, 0.0, 1.0) if full > 0 else light
    pitch = lenslet_pitch(layout)
    angle = np.deg2rad(layout.angle_deg)
    along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotated = layout.centres @ along / pitch  # x along the rows
    disk, error, inside, cuts = _disk_of(rotated, light, 6 if layout.geometry == "hexagonal" else 4)
    x, y = along @ disk[:2] * pitch
    farthest = float(np.hypot(*(layout.centres[inside] - (x, y)).T).max())
    radius = disk[2] * pitch
    side, diameter = layout.subaperture_m, layout.diameter_m
    if side is not None and diameter is not None:
        across = 2 * radius / pitch
        radius, error, cuts = 0.5 * pitch * diameter / side, 0.0, True
        unlit = diameter / side - across > max(_MOST_UNLIT, 0.1 * across)
        if unlit or farthest > radius + pitch / np.sqrt(2):
            extent = f"{across:.3g}" if unlit else f"{2 * farthest / pitch:.3g} between the farthest centres"
            raise InputError(
                f"layout.diameter_m = {diameter:g} and layout.subaperture_m = {side:g}: "
                f"{diameter / side:.3g} sub-apertures across, but those with flux extend over {extent}; "
                "state the diameter of the illuminated part, or only one of the two lengths"
            )
    elif side is not None:
        diameter = 2 * radius / pitch * side
    metres = None if diameter is None else diameter / 2
    return Pupil((float(x), float(y)), radius, radius / pitch, metres, error, cuts, not inside.all())


def _disk_of(at: Floats, light: Floats, sides: int) -> tuple[Floats, float, NDArray[np.bool_], bool]:
    """Return centre and radius of the disk, the radius' error, lenslets inside, and whether it cuts them.

    Lengths are in pitches: of lenslets at (n, 2), with relative flux `light` (n,), and 4 or 6 neighbours.
    """
    from scipy.optimize import minimize  # imported here: they take longer than the first slopes
    from scipy.spatial import cKDTree

    turns = 2 * np.pi * np.arange(sides) / sides
    beside = (at[:, None] + np.stack([np.cos(turns), np.sin(turns)], axis=-1)).reshape(-1, 2)
    beside = beside[cKDTree(at).query(beside)[0] > 0.5]  # not in the layout: they have no more than half

    def share(disk: Floats, of: Floats) -> Floats:
        away = np.abs(of - disk[:2]) + 1e-9
        distance = np.hypot(*away.T)
        return np.asarray(np.clip(0.5 + (disk[2] - distance) * distance / away.sum(axis=1), 0.0, 1.0))

    def misfit(disk: Floats) -> float:
        missing = np.maximum(share(disk, beside) - 0.5, 0.0)
        return float(np.abs(light - share(disk, at)).sum() + missing.sum())

    lit = light > 0
    middle = np.median(at[lit], axis=0)
    most = float(np.quantile(np.hypot(*(at[lit] - middle).T), 0.9)) + 0.5
    steps = np.concatenate([np.zeros((1, 3)), 0.5 * np.diag([1.0, 1.0, -1.0])])
    options = {"xatol": 0.01, "fatol": 0.01}
    fits = [
        minimize(misfit, start, method="Nelder-Mead", options={**options, "initial_simplex": start + steps})
        for start in (_around(at[lit]), np.append(middle, most))
    ]
    disk: Floats = min(fits, key=lambda fit: float(fit.fun)).x
    around = _around(at[lit])
    low, high = at[lit].min(axis=0) - 0.5, at[lit].max(axis=0) + 0.5
    lacking = ((beside > low) & (beside < high)).all(axis=1)
    if float((1 - light).sum()) + 0.5 * np.count_nonzero(lacking) < misfit(disk):
        return around, 0.0, lit, False  # a square array
    inside = np.asarray(lit & (np.hypot(*(at - disk[:2]).T) < disk[2] + 0.5))
    around = _around(at[inside])
    edge = np.abs(np.hypot(*(at - disk[:2]).T) - disk[2]) < 1
    partly = np.abs(light[edge] - 0.5) < _PARTLY
    cuts = misfit(around) > misfit(disk) + _WHOLE and float(np.sum(partly)) > _CUT * len(partly)
    disk = disk if cuts else around
    difference = light[edge] - share(disk, at[edge])
    # Differences of neighbours are alike: of four, about one is independent.
    return disk, 2 * float(np.linalg.norm(difference)) / max(len(difference), 1), inside, cuts


def _around(at: Floats) -> Floats:
    """Return centre and half the longer side of the rectangle around lenslets at (n, 2), in pitches."""
    low, high = at.min(axis=0), at.max(axis=0)
    return np.append((low + high) / 2, 0.5 * (float((high - low).max()) + 1.0))


def lit_subapertures(flags: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which sub-apertures have flux, from the flags of their slopes, (n,); all of them if none has.

    They have it in at least half as many frames as the one that has it most often. Those with too many bad
    pixels count as long as no other one is dark.
    """
    flags = np.atleast_2d(flags)
    often = (flags & int(SubapertureFlag.NO_FLUX) == 0).mean(axis=0)
    lit = often >= max(0.5 * often.max(), 1e-9)
    if not lit.all():
        lit &= ~(flags & int(SubapertureFlag.TOO_MANY_BAD_PIXELS) > 0).all(axis=0)
    return np.asarray(lit if lit.any() else ~lit)


def inside_pupil(layout: Layout, pupil: Pupil) -> NDArray[np.bool_]:
    """Return which sub-apertures have their centre within the disk, (n,)."""
    away = np.hypot(*(layout.centres - pupil.centre_px).T)
    return np.asarray(away <= pupil.radius_px * (1 + 1e-9))


def lit_outlines(layout: Layout, pupil: Pupil) -> tuple[Floats, Floats]:
    """Return the part of each lenslet that lies within the disk, and its share of the lenslet's area.

    Returns
    -------
    outlines : (n, corners, 2) array
        Corners in frame pixels, ordered as by `lenslet_outlines`; the last is repeated where there are fewer.
    share : (n,) array
        From 0 (outside) to 1.
    """
    whole = lenslet_outlines(layout)
    turns = 2 * np.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    # A polygon of the disk's area, whose edges cut the lenslets one after the other (Sutherland-Hodgman).
    radius = pupil.radius_px * np.sqrt(2 * np.pi / _DISK_CORNERS / np.sin(2 * np.pi / _DISK_CORNERS))
    normals = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    distance = radius * np.cos(np.pi / _DISK_CORNERS)
    parts = [_cut(outline - pupil.centre_px, normals, distance) for outline in whole]
    longest = max(len(part) for part in parts)
    outlines = np.stack([np.pad(part, ((0, longest - len(part)), (0, 0)), "edge") for part in parts])
    return outlines + pupil.centre_px, _areas(outlines) / _areas(whole)


def _cut(outline: Floats, normals: Floats, distance: float) -> Floats:
    """Return the part of a convex polygon where points times each normal are at most the distance."""
    for normal in normals[(outline @ normals.T > distance).any(axis=0)]:
        depth = distance - outline @ normal
        following, after = np.roll(outline, -1, axis=0), np.roll(depth, -1)
        corners = []
        for point, inside, next_point, next_inside in zip(outline, depth, following, after, strict=True):
            if inside >= 0:
                corners.append(point)
            if inside * next_inside < 0:
                corners.append(point + (next_point - point) * inside / (inside - next_inside))
        if len(corners) < 3:
            return np.zeros((3, 2))
        outline = np.array(corners)
    return outline


def _areas(outlines: Floats) -> Floats:
    """Return the areas of polygons (n, corners, 2)."""
    x, y = outlines[..., 0], outlines[..., 1]
    areas: Floats = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    return areas


def lenslet_pitch(layout: Layout) -> float:
    """Return the distance of neighbouring lenslets [px]; the side of the window if it is unknown."""
    return float(max(layout.window)) if layout.pitch_px is None else layout.pitch_px


def lenslet_outlines(layout: Layout, part: float = 1.0) -> Floats:
    """Return the corners of each lenslet's square or hexagon in frame pixels, (n, 4 or 6, 2).

    They are ordered from +x towards +y; `part` shrinks the lenslets, leaving gaps between them.
    """
    pitch = part * lenslet_pitch(layout)
    if layout.geometry == "hexagonal":
        angles, radius = 30.0 + 60.0 * np.arange(6), pitch / np.sqrt(3)
    else:
        angles, radius = 45.0 + 90.0 * np.arange(4), pitch / np.sqrt(2)
    direction = np.deg2rad(angles + layout.angle_deg)
    ring = radius * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    outlines: Floats = layout.centres[:, None, :] + ring
    return outlines


def subapertures_across(cells: NDArray[np.int64]) -> int:
    """Return the number of sub-apertures across an array, from their rows and columns (n, 2)."""
    return int(np.ptp(cells, axis=0).max()) + 1


def side_m(
    cells: NDArray[np.int64],
    subaperture_m: float | None,
    diameter_m: float | None,
    flags: NDArray[Any] | None = None,
) -> float | None:
    """Return the side of a sub-aperture, given or from the diameter of the pupil; None without either.

    With the flags of slopes (n_frames, n), the pupil is that of the sub-apertures with flux.
    """
    if subaperture_m is None and diameter_m is not None:
        return diameter_m / subapertures_across(cells if flags is None else cells[lit_subapertures(flags)])
    return subaperture_m
