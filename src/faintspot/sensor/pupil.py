"""Where the sub-apertures are in the telescope's pupil: their outlines, and the circle around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.sensor.layout import Layout

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pupil:
    """The disk of the telescope's pupil, as it lies on the lenslets."""

    centre_px: tuple[float, float]
    """x, y in the frame."""
    radius_px: float
    """Also in the frame: neighbouring lenslets are the layout's pitch apart there."""
    radius_subapertures: float
    """In sides of a sub-aperture."""
    radius_m: float | None
    """In the entrance pupil; None when the layout does not say how large that is."""


def pupil_of(layout: Layout) -> Pupil:
    """Return the disk of the pupil.

    Its middle is that of the rectangle along the lattice's rows that holds all lit sub-apertures, and its
    diameter the longer side, so that corners of a square array are outside; with both `subaperture_m` and
    `diameter_m`, their ratio.

    Raises
    ------
    InputError
        If these two make a disk in which not all centres of sub-apertures lie.
    """
    pitch = lenslet_pitch(layout)
    angle = np.deg2rad(layout.angle_deg)
    along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotated = layout.centres @ along  # x along the rows
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    x, y = along @ ((low + high) / 2)
    farthest = float(np.hypot(*(layout.centres - (x, y)).T).max())
    radius = 0.5 * (float((high - low).max()) + pitch)
    side, diameter = layout.subaperture_m, layout.diameter_m
    if side is not None and diameter is not None:
        radius = 0.5 * pitch * diameter / side
        if farthest > radius:
            raise InputError(
                f"layout.diameter_m = {diameter:g} and layout.subaperture_m = {side:g}: "
                f"{diameter / side:.3g} sub-apertures across, but lit ones lie "
                f"{2 * farthest / pitch:.3g} apart"
            )
    elif side is not None:
        diameter = 2 * radius / pitch * side
    metres = None if diameter is None else diameter / 2
    return Pupil((float(x), float(y)), radius, radius / pitch, metres)


def inside_pupil(layout: Layout, pupil: Pupil) -> NDArray[np.bool_]:
    """Return which sub-apertures have their centre within the disk, (n,)."""
    away = np.hypot(*(layout.centres - pupil.centre_px).T)
    return np.asarray(away <= pupil.radius_px * (1 + 1e-9))


def lenslet_pitch(layout: Layout) -> float:
    """Return the distance of neighbouring lenslets, px; the window's side where it is not known."""
    return float(max(layout.window)) if layout.pitch_px is None else layout.pitch_px


def lenslet_outlines(layout: Layout, part: float = 1.0) -> Floats:
    """Return the corners of each lenslet's square or hexagon in frame pixels, (n, 4 or 6, 2).

    They go round from +x towards +y; `part` makes lenslets smaller, with gaps between them.
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
