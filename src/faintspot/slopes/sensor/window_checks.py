"""Checks of windows and sub-apertures, and lattices of which the user states pitch, angle or a point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between, one_of
from faintspot.base.errors import InputError

if TYPE_CHECKING:
    from faintspot.slopes.sensor.detection.lenslets import LensletGrid


def chosen_index(chosen: object, length: int) -> NDArray[np.int64]:
    """Return the numbers of the selected sub-apertures."""
    if isinstance(chosen, slice):
        index = np.arange(length)[chosen]
    else:
        try:
            array = np.asarray(chosen)
        except ValueError:  # rows of different lengths
            array = np.empty((0, 0))
        if array.ndim != 1:
            raise InputError("layout[...]: expected a mask, a slice or a list of numbers")
        if array.dtype == np.bool_:
            if len(array) != length:
                raise InputError(f"layout[mask]: expected a mask of {length}, got {len(array)}")
            index = np.flatnonzero(array)
        else:
            index = numbers_between("layout[...]", array, -length, length - 1, integer=True) % length
            if len(np.unique(index)) < len(index):
                raise InputError("layout[...]: expected each sub-aperture once, got one twice")
    if len(index) == 0:
        raise InputError("layout[...]: expected at least one sub-aperture, got none")
    return np.asarray(index)


def check_inside(corners: NDArray[np.int64], window: tuple[int, int], frame_shape: tuple[int, int]) -> None:
    """Raise an error if a window leaves the frame."""
    outside = np.any((corners < 0) | (corners + np.array(window) > np.array(frame_shape)), axis=1)
    if outside.any():
        first = int(np.argmax(outside))
        row, column = corners[first]
        raise InputError(
            f"layout: sub-aperture {first} (rows {row} to {row + window[0] - 1}, columns {column} to "
            f"{column + window[1] - 1}) leaves the frame of {frame_shape[0]} x {frame_shape[1]} pixels"
        )


def check_centres(offsets: NDArray[np.float64], window: tuple[int, int]) -> None:
    """Raise an error for implausible centres; aberrations may move spots by a pitch."""
    away = np.abs(offsets).max(axis=1)
    if away.max() > 3 * max(window):
        raise InputError(
            f"layout.centres: expected centres up to {3 * max(window)} px from their windows' middles, "
            f"got one {away.max():g} px away (sub-aperture {np.argmax(away)})"
        )


def check_overlap(corners: NDArray[np.int64], window: tuple[int, int]) -> None:
    """Raise an error if windows share a pixel: corners less than a window apart on both axes."""
    if _on_a_grid(corners, window):
        return
    from scipy.spatial import KDTree  # takes 0.2 s and is not needed for a regular grid

    apart, nearest = KDTree(corners / np.array(window)).query(corners / np.array(window), 2, p=np.inf)
    overlapping = np.flatnonzero(apart[:, 1] < 1 - 1e-9)
    if overlapping.size:
        index = int(overlapping[0])
        other = int(nearest[index][nearest[index] != index][0])
        raise InputError(
            f"layout: sub-apertures {min(index, other)} and {max(index, other)} overlap; use smaller windows "
            f"than {window}"
        )


def _on_a_grid(corners: NDArray[np.int64], window: tuple[int, int]) -> bool:
    """Return whether these are distinct cells of a grid whose lines are a window apart."""
    for axis, size in enumerate(window):
        if np.diff(np.unique(corners[:, axis])).min(initial=size) < size:
            return False
    return len(np.unique(corners, axis=0)) == len(corners)


SMALLEST_WINDOW, LARGEST_WINDOW = 2, 64
_ABSURD = 2**31  # beyond which a whole number may not fit its type


def window_size(name: str, value: object, factor: int = 1) -> tuple[int, int]:
    """Return height and width of a window, from one number or two; its frames are binned by `factor`."""
    window, largest = pair_of_numbers(name, value, -_ABSURD, _ABSURD), LARGEST_WINDOW * factor
    if max(window) > largest:
        needed = math.ceil(max(window) / LARGEST_WINDOW)
        raise InputError(
            f"expected at most {largest}; bin = {needed} allows larger windows", name=name, value=max(window)
        )
    numbers_between(name, window, SMALLEST_WINDOW * factor, largest)
    if any(side % factor for side in window):
        raise InputError(f"expected multiples of bin = {factor}, got {window[0]} x {window[1]}", name=name)
    return window


def pair_of_numbers(name: str, value: object, low: float, high: float) -> tuple[int, int]:
    """Return two whole numbers, from one or two."""
    array = numbers_between(name, value, low, high, integer=True)
    if array.ndim > 1 or array.size not in (1, 2):
        raise InputError(f"expected one or two whole numbers, got shape {array.shape}", name=name)
    first, second = np.broadcast_to(array, 2)
    return int(first), int(second)


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


def removed_terms(fitted: Sequence[str]) -> str:
    """Return which terms of the wavefront slopes lack whose lattice was fitted to a frame, in words."""
    *terms, last = (_REMOVED[name] for name in fitted)
    return f"{', '.join(terms)} and {last}" if terms else last
