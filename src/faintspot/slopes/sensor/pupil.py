"""Sub-apertures in the pupil of the telescope: their outlines, and the circle around them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]

_DISK_CORNERS = 256
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
    stated: bool = False
    """Whether the layout states the disk's size in sub-apertures: it is known where it cuts them."""
    part: bool = False
    """Whether the layout has sub-apertures without flux, which the disk does not count."""


def pupil_of(layout: Layout, flags: NDArray[Any] | None = None) -> Pupil:
    """Return the disk of the pupil.

    The centre is that of the rectangle along the rows of the lattice that contains all illuminated
    sub-apertures. The diameter is its longer side, so that corners of a square array are outside; if both
    `subaperture_m` and `diameter_m` are given, it is their ratio.

    Parameters
    ----------
    layout : Layout
    flags : (n,) or (n_frames, n) array of int, optional
        Flags of slopes. Default: all sub-apertures of the layout are illuminated.

    Raises
    ------
    InputError
        If these two give a disk outside which a sub-aperture lies as a whole, or one that the illuminated
        sub-apertures do not fill.
    """
    lit = np.ones(len(layout), np.bool_) if flags is None else lit_subapertures(flags)
    pitch = lenslet_pitch(layout)
    angle = np.deg2rad(layout.angle_deg)
    along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centres = layout.centres[lit]
    rotated = centres @ along  # x along the rows
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    x, y = along @ ((low + high) / 2)
    farthest = float(np.hypot(*(centres - (x, y)).T).max())
    radius = 0.5 * (float((high - low).max()) + pitch)
    side, diameter = layout.subaperture_m, layout.diameter_m
    stated = side is not None and diameter is not None
    if side is not None and diameter is not None:
        across = 2 * radius / pitch
        radius = 0.5 * pitch * diameter / side
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
    return Pupil((float(x), float(y)), radius, radius / pitch, metres, stated, not lit.all())


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
