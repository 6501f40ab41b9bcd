"""Background of frames with spots: smooth in the frame, or of single lenslets."""

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import MAD_TO_STD

Points = NDArray[np.complex128]
Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]

_WIDTHS = np.geomspace(0.4, 1.4, 36)  # of spots that overlap, over the width first taken
# Rounds, and those with spots that overlap, whose wings become background in more; and their over-relaxation:
# steps between lenslets first look like slopes of a smooth background.
_ROUNDS, _ROUNDS_BELOW_WINGS, _HASTE = 8, 4, 1.7
_HIGHEST = 0.7  # frequency of their spectra over the inverse of their width
_COVERED, _MOST_COVERED = 3.0, 0.42  # radius of a spot in its standard deviations; at most, in pitches
# Standard deviation of the smoothing in pitches: wings of the spots average out. At least in pixels: so does
# the noise. Pixels are summed to blocks of a sixth of it.
_SMOOTHED, _LEAST_SMOOTHED_PX = 0.5, 6.0
_RIDGE, _FARTHEST = 0.05, 1.0  # of the planes: variance, and distance from the middle, in their reach
_DARK_NODE = 0.5  # distance from all spots in pitches
# Of the flux of a spot, under its noise-equivalent area; wings of spots that overlap are known no better.
_MATTERS, _MATTERS_BELOW_WINGS = 0.05, 0.1
_PART = 0.02  # of the lenslets, in which it must matter
_CERTAIN, _OWN = 5.0, 2.0  # standard deviations: of the frame's background, and of that of a lenslet


def overlap(pitch_px: float, spot_px: float) -> bool:
    """Return whether the wings of spots of this standard deviation reach those of their neighbours."""
    return _COVERED * spot_px > _MOST_COVERED * pitch_px


def lenslet_background(
    frame: Floats, spots: Points, beside: Points, pitch_px: float, spot_px: float
) -> Floats:
    """Return the background in the cells of lit lenslets, between the spots and continued below them.

    Sky may be seen through lit lenslets only, so that the pixels of others do not count. Pixels of lit ones
    farther than three standard deviations from the spots are smoothed by planes with Gaussian weights (local
    regression, Cleveland 1979, without those below the spots); planes of what is left are added, so that
    reflections as narrow as two pitches stay. So is the median of what is then left of a lenslet, as far as
    it exceeds twice its error (non-negative garrote, Breiman 1995): lenslets see the sky through their own
    field stop, and partly lit ones see less. Spots so wide that they overlap are taken off first, as
    Gaussians of their height above the background: else their wings would be part of it.

    Parameters
    ----------
    frame : (h, w) array
        NaN in pixels to ignore.
    spots : (n,) array of complex
        Spots x + 1j * y [px].
    beside : (k,) array of complex
        Vectors to the neighbours of a spot.
    pitch_px, spot_px : float
        Distance of lenslets, and standard deviation of the spot shape.
    """
    at = _pixels(frame, spots)
    away_px, cell = _cells(frame.shape, spots, beside, pitch_px)
    lit = cell < len(spots)
    finite = np.isfinite(frame)
    level = float(np.median(frame[lit & finite])) if (lit & finite).any() else 0.0
    values = scipy.ndimage.median_filter(np.where(finite, frame, level), 3)  # of hot pixels
    overlaps = overlap(pitch_px, spot_px)
    if overlaps and not overlap(pitch_px, narrow := _overlapping(values, lit, at, spot_px)[0]):
        spot_px, overlaps = narrow, False
    usable = lit & finite & (away_px > min(max(_COVERED * spot_px, 2.0), _MOST_COVERED * pitch_px))
    smooth = _Planes(usable, max(_SMOOTHED * pitch_px, _LEAST_SMOOTHED_PX))
    taken, found, own = np.zeros((3, *frame.shape))
    for number in range(_ROUNDS_BELOW_WINGS if overlaps else _ROUNDS):
        if overlaps and number > 0:
            taken = _overlapping(values - found - own, lit, at, spot_px)[1]
        found = smooth(values - taken - own)
        own += _HASTE * (_of_lenslets(frame - taken - found, usable, cell, len(spots)) - own)
    outside = _Planes(~lit & finite, smooth.std_px)(values - taken)
    return np.where(lit, found + own, outside)


def values_at(image: Floats, points: Points) -> Floats:
    """Return the values of the pixels nearest to points x + 1j * y."""
    return np.asarray(image[_pixels(image, points)])


def _pixels(image: Floats, points: Points) -> Pixels:
    rows, columns = (np.rint(part).astype(np.int64) for part in (points.imag, points.real))
    return np.clip(rows, 0, image.shape[0] - 1), np.clip(columns, 0, image.shape[1] - 1)


def _cells(
    shape: tuple[int, ...], spots: Points, beside: Points, pitch_px: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the distance of each pixel from the nearest spot or dark node, and its number."""
    around = (spots[:, None] + beside).ravel()
    nodes = np.column_stack([spots.real, spots.imag])
    others = np.column_stack([around.real, around.imag])
    dark = scipy.spatial.cKDTree(nodes).query(others)[0] > _DARK_NODE * pitch_px
    y, x = np.indices(shape)
    tree = scipy.spatial.cKDTree(np.concatenate([nodes, others[dark]]))
    away_px, nearest = tree.query(np.stack([x, y], axis=-1))
    return away_px, nearest


class _Planes:
    """Planes fitted around each pixel to the usable ones, with Gaussian weights."""

    def __init__(self, usable: NDArray[np.bool_], std_px: float) -> None:
        self._usable, self.std_px, self._block = usable, std_px, int(std_px / _LEAST_SMOOTHED_PX)
        self._std = std_px / self._block
        weight = _block_means(usable.astype(np.float64), self._block)
        self._y, self._x = np.indices(weight.shape) / self._std
        x, y = self._x, self._y
        self._weight = np.maximum(self._blurred(weight), 1e-9)
        mean_x, mean_y, xx, xy, yy = (
            self._blurred(weight * part) / self._weight for part in (x, y, x * x, x * y, y * y)
        )
        self._middle = mean_x, mean_y
        xx, xy, yy = xx - mean_x**2 + _RIDGE, xy - mean_x * mean_y, yy - mean_y**2 + _RIDGE
        to_x, to_y = (np.clip(to, -_FARTHEST, _FARTHEST) for to in (x - mean_x, y - mean_y))
        area = xx * yy - xy**2
        self._to_x, self._to_y = (yy * to_x - xy * to_y) / area, (xx * to_y - xy * to_x) / area

    def __call__(self, image: Floats) -> Floats:
        """Return the planes of an image and, added, those of what is left."""
        level = float(np.median(image[self._usable])) if self._usable.any() else 0.0
        first = self._fitted(image - level)
        return level + first + self._fitted(image - level - first)

    def _fitted(self, image: Floats) -> Floats:
        values = _block_means(np.where(self._usable, image, 0.0), self._block)
        mean, along_x, along_y = (
            self._blurred(values * part) / self._weight for part in (1.0, self._x, self._y)
        )
        middle_x, middle_y = self._middle
        planes = mean + (along_x - mean * middle_x) * self._to_x + (along_y - mean * middle_y) * self._to_y
        return _between_blocks(planes, self._block, self._usable.shape)

    def _blurred(self, image: Floats) -> Floats:
        return np.asarray(scipy.ndimage.gaussian_filter(image, self._std, mode="constant"))


def _block_means(image: Floats, side: int) -> Floats:
    """Return the means of blocks of so many pixels on a side; the edge continues in those that it cuts."""
    rows, columns = (-(-pixels // side) for pixels in image.shape)
    blocks = np.pad(image, [(0, -pixels % side) for pixels in image.shape], mode="edge")
    return np.asarray(blocks.reshape(rows, side, columns, side).mean(axis=(1, 3)))


def _between_blocks(means: Floats, side: int, shape: tuple[int, ...]) -> Floats:
    """Return values at the pixels of an image (h, w), linear between the middles of blocks."""
    if side == 1:
        return means
    at = np.meshgrid(*((np.arange(pixels) + 0.5) / side - 0.5 for pixels in shape), indexing="ij")
    return np.asarray(scipy.ndimage.map_coordinates(means, at, order=1, mode="nearest"))


def _of_lenslets(rest: Floats, usable: NDArray[np.bool_], cell: NDArray[np.int64], count: int) -> Floats:
    """Return the median of what is left of each lenslet, less what noise explains, at its pixels."""
    own = cell[usable]
    pixels = np.bincount(own, minlength=count)
    median = np.zeros(count + 1)
    lenslets = np.flatnonzero(pixels)
    median[lenslets] = scipy.ndimage.median(rest[usable], own, lenslets)
    pairs = usable[:, 1:] & usable[:, :-1]
    differences = np.abs(np.diff(rest, axis=1)[pairs])
    noise = MAD_TO_STD * float(np.median(differences)) / np.sqrt(2.0) if pairs.any() else 0.0
    # The median has pi / 2 times the variance of the mean.
    error = _OWN * noise * np.sqrt(0.5 * np.pi / np.maximum(np.append(pixels, 1), 1))
    shrunk = np.where(np.abs(median) > error, median - error**2 / np.where(median == 0, 1, median), 0.0)
    return np.asarray(shrunk[np.minimum(cell, count)])


def _overlapping(frame: Floats, lit: NDArray[np.bool_], at: Pixels, spot_px: float) -> tuple[float, Floats]:
    """Return the width that explains the frame best, and Gaussians of the frame's values at their middles.

    The background that is left is even in the cells of lit lenslets, and elsewhere.
    """
    heights, places = np.zeros(frame.shape), np.zeros(frame.shape)
    np.add.at(heights, at, frame[at])
    np.add.at(places, at, 1.0)
    parts = np.stack([frame, lit, ~lit, heights, places])
    squares = scipy.fft.fftfreq(len(frame))[:, None] ** 2 + scipy.fft.rfftfreq(frame.shape[1]) ** 2
    low = squares < (_HIGHEST / (spot_px * _WIDTHS[0])) ** 2
    spectra, squares = scipy.fft.rfft2(parts)[:, low], squares[low]
    fits = []
    for width in spot_px * _WIDTHS:
        spot = 2 * np.pi * width**2 * np.exp(-2 * (np.pi * width) ** 2 * squares)
        rest = spectra[0] - spot * spectra[3]
        shown = np.stack([spectra[1] - spot * spectra[4], spectra[2]])
        levels = np.linalg.lstsq((shown.conj() @ shown.T).real, (shown.conj() @ rest).real)[0]
        left = rest - levels @ shown
        fits.append((float(np.square(np.abs(left)).sum()), float(width), levels))
    _, width, levels = min(fits, key=lambda fit: fit[0])
    return width, _gaussians(frame.shape, at, frame[at] - levels[0], width)


def _gaussians(shape: tuple[int, ...], at: Pixels, heights: Floats, width_px: float) -> Floats:
    """Return the sum of Gaussians of these heights at rows and columns."""
    image = np.zeros(shape)
    np.add.at(image, at, heights)
    smoothed = scipy.ndimage.gaussian_filter(image, width_px, mode="constant")
    return np.asarray(2 * np.pi * width_px**2 * smoothed)


def least_difference(frame: Floats, flux: float, pitch_px: float, spot_px: float) -> float:
    """Return the difference between backgrounds of lenslets above which it changes their slopes.

    Parameters
    ----------
    frame : (h, w) array
        Frame of which the background was taken, for its noise.
    flux : float
        Typical flux of a spot, in the same unit.
    pitch_px, spot_px : float
        Distance of lenslets, and standard deviation of the spot shape.
    """
    differences = np.diff(frame, axis=1)
    noise = MAD_TO_STD * float(np.nanmedian(np.abs(differences))) / np.sqrt(2.0)
    # Twice smoothed, and half of the pixels used.
    certain = _CERTAIN * noise * 0.5 / max(_SMOOTHED * pitch_px, _LEAST_SMOOTHED_PX)
    part = _MATTERS_BELOW_WINGS if overlap(pitch_px, spot_px) else _MATTERS
    return float(max(part * flux / (4 * np.pi * spot_px**2), certain))


def varies(levels: Floats, least: float) -> bool:
    """Return whether backgrounds (n,) of more than a few lenslets differ by more than this from most."""
    return bool(np.mean(np.abs(levels - np.median(levels)) > least) > _PART)
