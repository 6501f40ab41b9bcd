"""Layout: positions of the sub-apertures on the detector."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, number_between, numbers_between
from faintspot.base.errors import DoubtWarning, InputError, drawn, errors_within
from faintspot.base.files import check_size
from faintspot.base.options import TEXTS, number, setting
from faintspot.base.tables import ConfigurationTable
from faintspot.base.text_files import check_keys, checked_table
from faintspot.slopes.sensor.window_checks import (
    check_centres,
    check_inside,
    check_overlap,
    chosen_index,
    pair_of_numbers,
    window_size,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from faintspot.slopes.sensor.windows import Windows

GRID_KEYS = ("shape", "pixels", "outer_radius", "inner_radius", "pitch", "origin", "frame_shape")
GEOMETRIES = ("square", "hexagonal")
OPTICS = ("pixel_scale_arcsec", "subaperture_m", "diameter_m")
"""Fields that define scales on the sky and in the pupil."""
_MOST_LENSLETS = 1 << 20
_LARGEST_PX = 1e9
LARGEST_BIN = 64
"""Largest `bin`."""
_optics = partial(number, None, 0.0, _LARGEST_PX, low_open=True)


@dataclass(frozen=True)
class Layout(ConfigurationTable, table="layout"):
    """Positions of the sub-apertures: one window of the same size for each illuminated lenslet.

    Parameters
    ----------
    frame_shape : (int, int)
        Height and width of a frame [px].
    window : (int, int)
        Height and width of each sub-aperture [px], 2 (quad cells) to 64, times `bin`.
    corners : (n, 2) array of int
        Row and column of the first pixel of each window.
    centres : (n, 2) array, optional
        x, y of each sub-aperture's centre in frame pixels (pixel i is centred at i), from which positions are
        measured. The distance from the window centre is at most three times the longer side of the window.
        Default: the window centre.
    cells : (n, 2) array of int, optional
        Row and column of each lenslet in its array, for maps.
    geometry : {"square", "hexagonal"}
    pitch_px : float, optional
        Distance between neighbouring lenslets.
    angle_deg : float
        Angle of the rows of the lenslet array from +x towards +y.
    pixel_scale_arcsec : float, optional
        Angle on the sky per detector pixel, which converts slopes to angles.
    subaperture_m, diameter_m : float, optional
        Side of a sub-aperture (the pitch of the lenslets) and diameter of the telescope, in the entrance
        pupil. Either one is sufficient for wavefronts in nm: illuminated sub-apertures are then taken to
        span the pupil. With both, it is known where the pupil's edge cuts them.
    fitted : tuple of {"centre", "pitch", "angle"}
        Parameters of the lattice that were fitted to a frame: slopes lack that frame's tilt, defocus and
        rotation.
    doubts : tuple of str
        What may be wrong with a layout found in a frame, one sentence each.
    spots_left_out : int
        Number of lit spots in the frame, measurable to 0.1 px, that are in no sub-aperture.
    bin : int
        Slopes are measured in sums of bin x bin pixels, for windows over 64 px and colour mosaics. All fields
        are in the camera's pixels; windows and corners are multiples of it.

    Raises
    ------
    InputError
        If the layout is empty, a window leaves the frame, windows overlap, a centre is far from its window,
        or there are more than 2^28 pixels or 2^20 lenslets.

    Examples
    --------
    >>> import faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    >>> len(layout), layout.frame_shape, layout.window
    (36, (112, 112), (16, 16))
    """

    frame_shape: tuple[int, int]
    window: tuple[int, int]
    corners: NDArray[np.int64]
    centres: NDArray[np.float64] = None  # type: ignore[assignment]
    cells: NDArray[np.int64] = None  # type: ignore[assignment]
    geometry: str = setting("square", choices=GEOMETRIES)
    pitch_px: float | None = _optics()
    angle_deg: float = number(0.0, -360, 360)
    pixel_scale_arcsec: float | None = _optics(
        "Side of a pixel on the sky: for slopes in arcsec and wavefronts.", unit="arcsec"
    )
    subaperture_m: float | None = _optics("Side of a sub-aperture in the telescope's pupil.", unit="m")
    diameter_m: float | None = _optics("Diameter of the telescope's pupil.", unit="m")
    fitted: tuple[str, ...] = setting((), kind=TEXTS)
    doubts: tuple[str, ...] = setting((), kind=TEXTS)
    spots_left_out: int = number(0, 0, _MOST_LENSLETS, whole=True)
    bin: int = number(1, 1, LARGEST_BIN, whole=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        put = object.__setattr__
        put(self, "frame_shape", pair_of_numbers("layout.frame_shape", self.frame_shape, 1, 2**31))
        check_size("layout.frame_shape", self.frame_shape, what="pixels")
        put(self, "window", window_size("layout.window", self.window, self.bin))
        corners = _rows_of_two("layout.corners", self.corners)
        corners = numbers_between("layout.corners", corners, -(2**31), 2**31, integer=True)
        if (corners % self.bin).any():
            raise InputError(
                f"layout.corners: expected multiples of bin = {self.bin}; `faintspot layout --bin` makes them"
            )
        middle = corners[:, ::-1] + 0.5 * (np.array(self.window[::-1]) - 1)
        centres = middle if self.centres is None else _rows_of_two("layout.centres", self.centres)
        pitch = np.array(self.window)
        cells = (corners - corners.min(axis=0)) // pitch if self.cells is None else self.cells
        cells = _rows_of_two("layout.cells", cells)
        cells = numbers_between("layout.cells", cells, -_MOST_LENSLETS, _MOST_LENSLETS, integer=True)
        for name, array in (("centres", centres), ("cells", cells)):
            if len(array) != len(corners):
                raise InputError(
                    f"layout.{name}: expected {len(corners)} rows, one per corner, got {len(array)}"
                )
        check_size("layout.cells", (np.ptp(cells, axis=0) + 1).tolist(), _MOST_LENSLETS, "lenslets")
        check_inside(corners, self.window, self.frame_shape)
        check_centres(centres - middle, self.window)
        check_overlap(corners, self.window)
        for name, array in (("corners", corners), ("centres", centres.astype(np.float64)), ("cells", cells)):
            array = array.copy()
            array.flags.writeable = False
            put(self, name, array)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Layout):
            return NotImplemented
        mine, theirs = vars(self), vars(other)
        return all(np.array_equal(mine[name], theirs[name]) for name in mine)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Return a one-line summary, since arrays of a layout have hundreds of rows."""
        pitch = "" if self.pitch_px is None else f", pitch_px={self.pitch_px:.4g}"
        return (
            f"<Layout: {len(self)} sub-apertures, frame_shape={self.frame_shape}, window={self.window}, "
            f"geometry={self.geometry!r}{pitch}>"
        )

    def plot(self, frame: ArrayLike | None = None, axes: Axes | None = None) -> Axes:
        """Draw the windows on a frame, as the picture of `faintspot layout`, or outlines of the lenslets.

        Parameters
        ----------
        frame : (h, w) or (n, h, w) array, optional
            Several are averaged.
        axes : matplotlib Axes, optional
            Default: new ones.

        Returns
        -------
        Axes

        Raises
        ------
        InputError
            If the frame is not of the layout's shape.
        MissingExtraError
            If matplotlib is not installed.
        """
        axes = drawn("slopes.sensor.drawing:plot_layout", self, frame, axes)
        return axes

    def __len__(self) -> int:
        """Return the number of sub-apertures."""
        return len(self.corners)

    def __getitem__(self, chosen: object) -> Layout:
        """Return the layout of some of the sub-apertures, in the given order.

        Parameters
        ----------
        chosen : (n,) array of bool, slice or list of int
            Mask of all sub-apertures, or numbers of those to select.

        Raises
        ------
        InputError
            If a mask has the wrong length, a number is out of range or repeated, or none is selected.
        """
        index = chosen_index(chosen, len(self))
        return replace(
            self, corners=self.corners[index], centres=self.centres[index], cells=self.cells[index]
        )

    __iter__ = None  # otherwise Python would use __getitem__, which does not accept a single number

    @property
    def pixels(self) -> int:
        """Number of pixels of a window."""
        return self.window[0] * self.window[1]

    @property
    def offsets(self) -> NDArray[np.float64]:
        """Offsets x, y of the sub-aperture centres from the window centres, (n, 2) px."""
        return self.centres - (self.corners[:, ::-1] + 0.5 * (np.array(self.window[::-1]) - 1))

    @classmethod
    def grid(
        cls,
        shape: tuple[int, int],
        *,
        pixels: int | tuple[int, int],
        outer_radius: float | None = None,
        inner_radius: float | None = None,
        pitch: int | tuple[int, int] | None = None,
        origin: tuple[int, int] = (0, 0),
        frame_shape: tuple[int, int] | None = None,
        bin: int = 1,
        **optics: Any,
    ) -> Layout:
        """Make a regular grid of sub-apertures under an annular pupil.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of lenslets.
        pixels : int or (int, int)
            Height and width of a window.
        outer_radius, inner_radius : float, optional
            Radii of the pupil in lenslets: a sub-aperture is illuminated if the distance of its centre from
            the middle of the grid is between `inner_radius` and `outer_radius`. Default: all are
            illuminated. (7, 7) with 3.5 and 0.5 gives the 36 sub-apertures of a 4.2 m telescope with
            central obstruction.
        pitch : int or (int, int), optional
            Rows and columns between adjacent windows. Default: `pixels`.
        origin : (int, int)
            Row and column of the first pixel of the first window.
        frame_shape : (int, int), optional
            Default: the smallest frame that contains all windows.
        bin : int
            As for `Layout`.
        **optics
            pixel_scale_arcsec, subaperture_m and diameter_m, as for `Layout`.

        Raises
        ------
        InputError
            If no sub-aperture is illuminated, or as for `Layout`.
        """
        check_keys("", optics, OPTICS, what="argument")
        n_rows, n_columns = pair_of_numbers("shape", shape, 1, _LARGEST_PX)
        check_size("shape", (n_rows, n_columns), _MOST_LENSLETS, "lenslets")
        factor = int(number_between("bin", bin, 1, LARGEST_BIN, integer=True))
        window = window_size("pixels", pixels, factor)
        step = window if pitch is None else pair_of_numbers("pitch", pitch, 1, 10_000)
        start = pair_of_numbers("origin", origin, 0, 2**31)
        outer = np.inf if outer_radius is None else number_between("outer_radius", outer_radius, 0.0)
        inner = 0.0 if inner_radius is None else number_between("inner_radius", inner_radius, 0.0)
        cells = np.stack(np.meshgrid(np.arange(n_rows), np.arange(n_columns), indexing="ij"), -1).reshape(
            -1, 2
        )
        distance = np.hypot(*(cells - 0.5 * (np.array([n_rows, n_columns]) - 1)).T)
        cells = cells[(distance <= outer) & (distance >= inner)]
        if len(cells) == 0:
            name = f"outer_radius = {outer:g}, inner_radius = {inner:g}"
            raise InputError("no sub-aperture is illuminated", name=name)
        if frame_shape is None:
            last = np.array(start) + (np.array([n_rows, n_columns]) - 1) * step + window
            frame_shape = (int(last[0]), int(last[1]))
        corners = np.array(start) + cells * step
        return cls(frame_shape, window, corners, cells=cells, pitch_px=float(min(step)), bin=factor, **optics)

    @classmethod
    def stacked(cls, n: int, window: tuple[int, int], offsets: NDArray[np.float64] | None = None) -> Layout:
        """Return the layout of n images stacked into one tall frame.

        Parameters
        ----------
        n : int
        window : (int, int)
            Height and width of an image.
        offsets : (n, 2) array, optional
            x, y of each sub-aperture's centre from the centre of its image [px]. Default: 0.
        """
        ny, nx = window
        corners = np.column_stack([ny * np.arange(n), np.zeros(n, np.int64)])
        middles = corners[:, ::-1] + 0.5 * (np.array([nx, ny]) - 1)
        return cls((n * ny, nx), window, corners, middles if offsets is None else middles + offsets)

    @classmethod
    def from_frame(
        cls,
        frame: ArrayLike,
        *,
        geometry: str = "auto",
        pixels: int | tuple[int, int] | None = None,
        bad_pixels: ArrayLike | None = None,
        move_windows: bool = False,
        **options: Any,
    ) -> Layout:
        """Find the sub-apertures of a square or hexagonal lenslet array in a frame.

        Parameters
        ----------
        frame : (h, w) or (n, h, w) array
            Frame with spots, or several of the same field, which are averaged.
        geometry : {"auto", "square", "hexagonal"}
        pitch_px, angle_deg, centre, fit
            What is known of the lattice, and used as stated: see `faintspot.slopes.sensor.window_checks`.
        pixels : int or (int, int), optional
            Window, or its height and width. Default: the largest square windows that do not overlap.
        bad_pixels : (h, w) array of bool, optional
            True for pixels to ignore.
        move_windows : bool
            Whether all windows may be shifted, by up to 0.35 of their side, to include spots at the edge of
            the frame. Centres of gravity are less accurate in such windows.
        **options
            Passed on to `faintspot.slopes.sensor.windows.find_windows`.

        Returns
        -------
        Layout
            Illuminated sub-apertures whose windows are within the frame. Windows are centred on the lattice
            of the spots, unless shifted, or following spots moved by over a quarter of the pitch; `centres`
            contain the lattice. A doubt about it is in `doubts`, and a `DoubtWarning`.
            `faintspot.slopes.sensor.found_layout.find_layout` lists the spots left out, and doubtful ones.

        Raises
        ------
        InputError
            If no regular array of spots is found.
        """
        from faintspot.slopes.sensor.windows import find_windows

        found = find_windows(
            frame,
            pixels=pixels,
            move_windows=move_windows,
            geometry=geometry,
            bad_pixels=bad_pixels,
            **options,
        )
        layout, doubt = cls.of_windows(found), found.lenslets.doubt
        if not doubt:
            return layout
        warnings.warn(f"doubtful layout: {doubt} (look at layout.plot(frame))", DoubtWarning, stacklevel=2)
        return replace(layout, doubts=(doubt,))

    @classmethod
    def of_windows(cls, found: Windows) -> Layout:
        """Return the layout of the windows within the frame."""
        grid, within = found.lenslets, found.within
        return cls(
            found.frame_shape,
            found.window,
            found.corners[within],
            grid.centres[within],
            grid.cells[within],
            grid.geometry,
            grid.pitch_px,
            grid.angle_deg,
            fitted=found.fitted,
            spots_left_out=int(np.count_nonzero(~within)) + len(found.outside),
        )

    @classmethod
    def from_table(cls, values: Mapping[str, object], path: Path | None = None) -> Layout:
        """Return the layout in a table, which may contain the arguments of `grid`; warn of unsettled doubts.

        Raises
        ------
        InputError
            If a key is unknown, or a value is missing or invalid.
        """
        if "grid" in values:
            with errors_within(path):
                return cls._of_grid(values)
        layout = super().from_table(values, path)
        if layout.doubts:
            settling = "look at its picture, then `faintspot layout --accept` or another layout settles it"
            text = f"{path}: doubtful layout: {'; '.join(layout.doubts)} ({settling})"
            warnings.warn(text, DoubtWarning, stacklevel=2)
        return layout

    @classmethod
    def _of_grid(cls, values: Mapping[str, Any]) -> Layout:
        check_keys("layout.", values, ["grid", "bin", *OPTICS], what="key beside grid")
        optics = {name: values[name] for name in ("bin", *OPTICS) if name in values}
        grid = checked_table("layout.grid", values["grid"])
        check_keys("layout.grid.", grid, GRID_KEYS, required=("shape", "pixels"))
        try:
            return cls.grid(**grid, **optics)
        except InputError as error:
            raise error if error.name.startswith("layout.") else error.within("", "layout.grid.") from None

    def images(self, frame: ArrayLike) -> NDArray[Any]:
        """Return the windows of a frame (h, w) or frames (n, h, w): (n_subapertures, ny, nx) or (n, ...)."""
        array = np.asarray(frame)
        if array.shape[-2:] != self.frame_shape:
            raise InputError(f"frame: expected (height, width) = {self.frame_shape}, got {array.shape[-2:]}")
        return array[(..., *self.window_pixels)]

    @property
    def window_pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows (n, ny, 1) and columns (n, 1, nx) of the windows' pixels in the frame."""
        rows = self.corners[:, 0, None, None] + np.arange(self.window[0])[:, None]
        return rows, self.corners[:, 1, None, None] + np.arange(self.window[1])


def _rows_of_two(name: str, value: object) -> NDArray[Any]:
    array = numbers_between(name, value)
    check_shape(name, array, ("n", 2))
    return array
