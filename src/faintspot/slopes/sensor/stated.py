"""Lattices of which the user states the pitch, the angle or a point, and what the fitted rest removes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.checks import finite_array, number_between, one_of
from faintspot.base.errors import InputError

if TYPE_CHECKING:
    from faintspot.slopes.sensor.detection.lenslets import LensletGrid

CENTRE, PITCH, ANGLE = LATTICE = ("centre", "pitch", "angle")
"""Parameters of a lattice; the reference positions follow from them."""
_REMOVED = {CENTRE: "tilt", PITCH: "defocus", ANGLE: "rotation"}


def with_stated(
    grid: LensletGrid,
    *,
    pitch_px: float | None = None,
    angle_deg: float | None = None,
    centre: object = None,
    fit: Sequence[str] = (),
) -> tuple[LensletGrid, tuple[str, ...]]:
    """Return the lenslets with the lattice as stated; windows stay where they are.

    What is not stated stays as fitted to the spots; without a stated centre, the lattice keeps its mean.

    Parameters
    ----------
    grid : LensletGrid
        Lenslets, with the lattice that fits the spots best.
    pitch_px, angle_deg : float, optional
    centre : (x, y), optional
        Point of the lattice in the frame [px]: the middle of a lenslet, of an edge, or a corner, whichever
        the fitted lattice has nearest.
    fit : sequence of {"centre", "pitch", "angle"}
        What stays as fitted although it is stated.

    Returns
    -------
    LensletGrid
    tuple of str
        Names of the parameters that were fitted to the frame.

    Raises
    ------
    InputError
        If a value is out of range, or a name in `fit` is unknown.
    """
    for name in fit:
        one_of("fit", name, LATTICE)
    given = {CENTRE: centre, PITCH: pitch_px, ANGLE: angle_deg}
    fitted = tuple(name for name in LATTICE if given[name] is None or name in fit)
    if fitted == LATTICE:
        return grid, fitted
    across = 60.0 if grid.geometry == "hexagonal" else 90.0
    rows, columns = grid.cells.T
    nodes = columns + rows * np.exp(1j * np.deg2rad(across))
    places = grid.centres @ (1, 1j)
    found = grid.pitch_px * np.exp(1j * np.deg2rad(grid.angle_deg))
    pitch = grid.pitch_px if PITCH in fitted else number_between("pitch_px", pitch_px, 0.0, low_open=True)
    angle = grid.angle_deg if ANGLE in fitted else number_between("angle_deg", angle_deg, -360.0, 360.0)
    pivot, pivot_place = nodes.mean(), places.mean()
    if CENTRE not in fitted:
        point = finite_array("centre", centre)
        if point.shape != (2,):
            raise InputError(f"expected x and y [px], got {point.size} numbers", name="centre")
        stated = complex(point[0], point[1])
        pivot, pivot_place = _half_node(pivot + (stated - pivot_place) / found, across), stated
    lattice = pivot_place + pitch * np.exp(1j * np.deg2rad(angle)) * (nodes - pivot)
    centres = np.stack([lattice.real, lattice.imag], axis=-1)
    drifts = grid.centres + grid.drifts - centres
    return replace(grid, centres=centres, drifts=drifts, pitch_px=pitch, angle_deg=angle), fitted


def _half_node(place: complex, across_deg: float) -> complex:
    """Return the point with whole or half row and column that is nearest to a place, in pitches."""
    direction = np.exp(1j * np.deg2rad(across_deg))
    row = place.imag / direction.imag
    column = place.real - row * direction.real
    row, column = (np.rint(2 * value) / 2 for value in (row, column))
    return complex(column + row * direction)


def reference_in_words(fitted: Sequence[str]) -> str:
    """Return which terms of the wavefront slopes lack whose reference was fitted, and how to keep them.

    Empty if nothing was fitted.
    """
    if not fitted:
        return ""
    terms = [_REMOVED[name] for name in fitted]
    words = " and ".join([", ".join(terms[:-1]), terms[-1]] if len(terms) > 1 else terms)
    return (
        f"the reference is the lattice fitted to the layout's frame: slopes lack that frame's {words}; "
        "faintspot layout with --pitch-px, --angle-deg, --centre, or --reference flat.npz, keeps them"
    )
