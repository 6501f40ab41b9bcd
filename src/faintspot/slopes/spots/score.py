"""Trained linear score: tables that convert the pixels around a spot to a correction of its position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, image_stack, number_between, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.npz import NpzFile
from faintspot.slopes.spots.fixed_weights import FixedWeights

STARTS = ("reference", "peak")
_LARGEST_PX = 1e6  # for a table or an error: larger than any frame
_BLOCK_IMAGES = 4096  # images processed at a time, to limit the memory of the gathered tables


@dataclass(frozen=True, eq=False)
class TrainedScore(NpzFile):
    """Tables of the trained linear score, made by `faintspot.train_estimator`; immutable.

    A pass changes the position x to ``q + sum psi(u - q) g / F``: q is x rounded to the grid of the table
    on both axes, g the image in electrons, u its pixel centres, F the expected flux, psi the table of the
    pass. Pixels outside the table are ignored.

    Parameters
    ----------
    tables : (n_kinds, n_classes, n_passes, 2, rows, columns) array
        psi for x ([..., 0, :, :]) and for y ([..., 1, :, :]) [px]. Node (r, c) is for a pixel whose centre
        is at ((c - (columns - 1) / 2) / steps_per_px, (r - (rows - 1) / 2) / steps_per_px) px from q; the
        numbers of rows and columns are odd. float32.
    flux_e : (n_classes,) array
        Flux [electrons] for which each class was trained, increasing. The class nearest in log flux is used.
    standard_error_px : (n_kinds, n_classes, 2) array
        Rms error in x and y, measured on samples not used for training.
    steps_per_px : int
        Number of table steps per pixel; even, so that pixel centres fall on nodes.
    start : {"reference", "peak"}
        Starting point of the first pass: the reference position, or the largest pixel of the image smoothed
        by a Gaussian of standard deviation `smoothing_px`.
    smoothing_px : float
        Width of the smoothing; only used with start "peak".
    index : (n_subapertures,) array of int, optional
        Kind of each sub-aperture. Default: one kind for all.

    Raises
    ------
    InputError
        If a value is not finite or out of range, or arrays are inconsistent.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> rng = np.random.default_rng(1)
    >>> images, truth = fs.slopes.simulate.subapertures(2000, shape=(8, 8), flux_e=50.0, rng=rng)
    >>> score = fs.train_estimator(flux_e=50.0, shape=(8, 8), realisations=4000, rng=rng)
    >>> print(f"R = {np.abs(score.apply(images, 50.0) - truth).mean():.2f} px")
    R = 0.09 px
    """

    WHAT = "a trained score"
    FIELDS = ("tables", "flux_e", "standard_error_px", "steps_per_px", "start", "smoothing_px", "index")

    tables: NDArray[np.float32]
    flux_e: NDArray[np.float64]
    standard_error_px: NDArray[np.float64]
    steps_per_px: int = 4
    start: str = "reference"
    smoothing_px: float = 1.3
    index: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        tables = numbers_between("score.tables", self.tables, -_LARGEST_PX, _LARGEST_PX).astype(np.float32)
        if tables.ndim != 6 or tables.shape[3] != 2 or tables.shape[4] % 2 == 0 or tables.shape[5] % 2 == 0:
            raise InputError(
                "score.tables: expected shape (kinds, classes, passes, 2, rows, columns) with odd rows and "
                f"columns, got {tables.shape}"
            )
        flux = numbers_between("score.flux_e", self.flux_e, 0.0, low_open=True)
        if flux.shape != (tables.shape[1],) or np.any(np.diff(flux) <= 0):
            raise InputError(f"score.flux_e: expected {tables.shape[1]} increasing fluxes, got {flux}")
        error = numbers_between("score.standard_error_px", self.standard_error_px, 0.0, _LARGEST_PX)
        if error.shape != (*tables.shape[:2], 2):
            raise InputError(
                f"score.standard_error_px: expected shape {(*tables.shape[:2], 2)}, got {error.shape}"
            )
        steps = int(number_between("score.steps_per_px", self.steps_per_px, 2, 64, integer=True))
        if steps % 2:
            raise InputError(f"score.steps_per_px = {steps}: expected an even number")
        checked: dict[str, Any] = {"tables": tables, "flux_e": flux, "standard_error_px": error}
        if self.index is not None:
            checked["index"] = _kinds_of_subapertures(self.index, len(tables))
        for array in checked.values():
            array.flags.writeable = False
        checked["steps_per_px"] = steps
        checked["start"] = one_of("score.start", self.start, STARTS)
        checked["smoothing_px"] = number_between("score.smoothing_px", self.smoothing_px, 0.0, 32.0)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TrainedScore):
            return NotImplemented
        own, theirs = vars(self), vars(other)
        return all(
            (own[name] is None) == (theirs[name] is None) and np.array_equal(own[name], theirs[name])
            for name in self.FIELDS
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def passes(self) -> int:
        """Number of corrections of the position."""
        return int(self.tables.shape[2])

    def flux_class(self, flux_e: ArrayLike) -> NDArray[np.int64]:
        """Return the class nearest in log flux for each flux [electrons]; the faintest class if <= 0.

        Raises
        ------
        InputError
            If a flux is not finite.
        """
        flux = finite_array("flux_e", flux_e).astype(np.float64)
        borders = np.sqrt(self.flux_e[1:] * self.flux_e[:-1])
        return np.searchsorted(borders, flux).astype(np.int64)

    def standard_error(self, flux_e: float) -> NDArray[np.float64]:
        """Return the standard error of x and y at a flux, interpolated between the classes in log flux.

        Outside the range of the classes it is that of the nearest one.

        Parameters
        ----------
        flux_e : float
            Expected flux [electrons], above 0.

        Returns
        -------
        (n_subapertures, 2) array, or (n_kinds, 2) without an index
            Standard errors [px].

        Raises
        ------
        InputError
            If the flux is not a positive number.
        """
        flux = np.log(number_between("flux_e", flux_e, 0.0, low_open=True))
        kinds = self.standard_error_px if self.index is None else self.standard_error_px[self.index]
        flat = kinds.transpose(0, 2, 1).reshape(-1, self.flux_e.size)
        return np.array([np.interp(flux, np.log(self.flux_e), row) for row in flat]).reshape(-1, 2)

    def apply(
        self,
        images: ArrayLike,
        flux_e: ArrayLike,
        start: ArrayLike | None = None,
        *,
        reference: ArrayLike = 0.0,
        search_range_px: float | None = None,
    ) -> NDArray[np.float64]:
        """Return the positions of spots, as a float64 reference implementation of the fast kernel.

        Parameters
        ----------
        images : (n, ny, nx) or (n_frames, n, ny, nx) array
            Images [electrons], background subtracted. With an index, n is the number of sub-apertures.
        flux_e : float or array that broadcasts to (n,) or (n_frames, n)
            Expected flux of the spots; for values <= 0 the starting point is returned.
        start : array that broadcasts to (..., n, 2), optional
            Starting positions, such as predicted ones. Default: given by `self.start`.
        reference : array that broadcasts to (..., n, 2)
            Reference positions, px from the window centre.
        search_range_px : float, optional
            Maximum distance from the reference on each axis. Default: half the longer side of the window.

        Returns
        -------
        (..., n, 2) array
            x and y in px from the window centre.

        Raises
        ------
        InputError
            If images are not real and finite, or arrays have the wrong shape.
        """
        stack = image_stack("images", images).astype(np.float64)
        if stack.ndim not in (3, 4):
            raise InputError(f"images: expected shape (n, ny, nx) or (frames, n, ny, nx), got {stack.shape}")
        leading, shape = stack.shape[:-2], (stack.shape[-2], stack.shape[-1])
        flat = stack.reshape(-1, *shape)
        flux = _spread("flux_e", flux_e, leading).ravel()
        home = _spread("reference", reference, (*leading, 2)).reshape(-1, 2)
        half = 0.5 * max(shape) if search_range_px is None else search_range_px
        half = number_between("search_range_px", half, 0.0, low_open=True)
        if start is not None:
            positions = _spread("start", start, (*leading, 2)).reshape(-1, 2)
        elif self.start == "peak":
            positions = smoothed_peak(flat, self.smoothing_px, home, half)
        else:
            positions = home
        positions = np.clip(positions, home - half, home + half)
        illuminated = np.maximum(flux, np.finfo(np.float32).tiny)
        for kind, level, members in self._groups(leading, self.flux_class(flux)):
            members = members[flux[members] > 0]
            relative = flat[members] / illuminated[members, None, None]
            for tables in self.tables[kind, level]:
                rounded = np.rint(positions[members] * self.steps_per_px) / self.steps_per_px
                moved = rounded + table_sums(relative, rounded, tables, self.steps_per_px)
                positions[members] = np.clip(moved, home[members] - half, home[members] + half)
        return positions.reshape(*leading, 2)

    def _groups(
        self, leading: tuple[int, ...], classes: NDArray[np.int64]
    ) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
        """Yield kind, flux class and indices of images that share both, in blocks."""
        index = np.zeros(leading[-1], np.int64) if self.index is None else self.index
        if len(index) != leading[-1]:
            raise InputError(
                f"images: expected {len(index)} sub-apertures as in the score, got {leading[-1]}"
            )
        kinds = np.broadcast_to(index, leading).ravel()
        for kind, level in np.unique(np.stack([kinds, classes], axis=1), axis=0):
            members = np.flatnonzero((kinds == kind) & (classes == level))
            for first in range(0, len(members), _BLOCK_IMAGES):
                yield int(kind), int(level), members[first : first + _BLOCK_IMAGES]


Score = TrainedScore | FixedWeights
"""Trained score or fixed weights applied by an estimator."""


def load_score(path: str | Path) -> Score:
    """Read a trained score, or fixed weights.

    Raises
    ------
    InputError
        If the file cannot be read or holds something else.
    """
    try:
        return FixedWeights.load(path)
    except InputError:
        return TrainedScore.load(path)


def table_sums(
    images: NDArray[np.floating[Any]],
    rounded: NDArray[np.float64],
    tables: NDArray[np.float32],
    steps_per_px: int,
) -> NDArray[np.float64]:
    """Return the sums of psi(u - q) times the images (n, ny, nx) over the pixels, for x and y: (n, 2)."""
    padded = np.pad(tables, ((0, 0), (1, 1), (1, 1)))  # outside the table: its border of zeros
    (ny, nx), (side_y, side_x) = images.shape[1:], padded.shape[1:]
    rows = nodes_of_pixels(ny, rounded[:, 1], side_y, steps_per_px)[:, :, None]
    columns = nodes_of_pixels(nx, rounded[:, 0], side_x, steps_per_px)[:, None, :]
    sums = [np.einsum("nij,nij->n", table[rows, columns], images, dtype=np.float64) for table in padded]
    return np.stack(sums, axis=1)


def nodes_of_pixels(
    n_pixels: int, position: NDArray[np.float64], n_nodes: int, steps_per_px: int
) -> NDArray[np.int64]:
    """Return the table node of each pixel centre around a position: (n, n_pixels), clipped to the border."""
    centres = np.arange(n_pixels) - 0.5 * (n_pixels - 1)
    nodes = np.rint((centres - position[:, None]) * steps_per_px).astype(np.int64) + (n_nodes - 1) // 2
    return np.clip(nodes, 0, n_nodes - 1)


def smoothed_peak(
    images: NDArray[np.float64], smoothing_px: float, reference: NDArray[np.float64], search_range_px: float
) -> NDArray[np.float64]:
    """Return the centre of the largest pixel of each smoothed image: (n, 2) px.

    Only pixels whose centre is within `search_range_px` + 0.5 of the reference on both axes are considered.
    The Gaussian is truncated at 2.5 standard deviations; the flux outside the image is taken to be 0.
    """
    n, ny, nx = images.shape
    reach = int(np.ceil(2.5 * smoothing_px))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(smoothing_px, 1e-6)) ** 2)
    smooth_x, smooth_y = (
        np.stack([np.convolve(row, taps)[reach : reach + size] for row in np.eye(size)]) for size in (nx, ny)
    )
    smoothed = smooth_y @ images @ smooth_x.T
    centres_x, centres_y = (np.arange(size) - 0.5 * (size - 1) for size in (nx, ny))
    limit = search_range_px + 0.5
    outside_x = np.abs(centres_x - reference[:, :1]) > limit
    outside_y = np.abs(centres_y - reference[:, 1:]) > limit
    smoothed[outside_y[:, :, None] | outside_x[:, None, :]] = -np.inf
    row, column = np.unravel_index(np.argmax(smoothed.reshape(n, -1), axis=1), (ny, nx))
    return np.stack([centres_x[column], centres_y[row]], axis=1)


def _spread(name: str, value: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return a writable copy of finite numbers, broadcast to a shape."""
    array = finite_array(name, value).astype(np.float64)
    try:
        return np.broadcast_to(array, shape).copy()
    except ValueError:
        raise InputError(f"{name}: shape {array.shape} does not broadcast to {shape}") from None


def _kinds_of_subapertures(index: object, n_kinds: int) -> NDArray[np.int64]:
    kinds = numbers_between("score.index", index, 0, n_kinds - 1, integer=True).astype(np.int64)
    if kinds.ndim != 1:
        raise InputError(f"score.index: expected shape (n_subapertures,), got {kinds.shape}")
    return kinds
