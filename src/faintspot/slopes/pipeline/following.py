"""Slopes of spots that leave their windows: windows that follow their spots from frame to frame."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.base.errors import InputError
from faintspot.base.flags import UNMEASURED, SubapertureFlag, scaled_positions
from faintspot.base.statistics import FWHM_TO_STD, mad_std
from faintspot.slopes.camera.calibration import binned
from faintspot.slopes.kernels.validity.doubtful import doubtful_scratch_size, flag_doubtful
from faintspot.slopes.pipeline.light import MeanLight
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.detection.acquisition import Acquired, FollowedDrift, acquire
from faintspot.slopes.sensor.detection.candidates import Lattice
from faintspot.slopes.sensor.detection.nodes import SpotImage, find_spots, spot_width
from faintspot.slopes.sensor.region import as_rows, neighbours_of

Complex = NDArray[np.complex128]

# Part of a spot's own motion, beyond that of its neighbours, that its window makes in one frame: noise moves
# it less. It moves at most `_MOST_OWN` pitches.
_OWN, _MOST_OWN = 0.5, 0.25
# Part of the usual number of spots found, below which all spots of a frame are matched anew, and of the
# lenslets that must be found then; weight of a frame in the usual number; common motion (pitches) above which
# they are matched anew, too.
_ENOUGH, _FEWEST, _WEIGHT, _FAR = 0.9, 0.5, 0.1, 0.4
# Standard deviations above which the mean of the windows shows a common motion, and smaller ones [px].
_CERTAIN, _SMALL_PX = 5.0, 1.5
_LEAST_APART_PX = 1.5  # spots nearer to each other, or than their FWHM, cross


class SpotFollower:
    """Measures spots that move out of their windows, each with a window that follows it.

    The spots of the first frame are matched to their lenslets from neighbour to neighbour. In every other
    frame each window is cut, at whole pixels, where the motion of the spot and of its neighbours lets expect
    the spot. Pixels nearer to another spot are replaced by the window's median. A slope is the shift of the
    window and the position in it. Where spots are lost at once, all spots of the frame are matched anew.

    Frames must be given in order: the object remembers where the spots are.

    Parameters
    ----------
    pipeline : SlopePipeline
        Pipeline whose layout states the pitch, for frames of at least four lenslets.

    Raises
    ------
    InputError
        If the layout has no pitch or fewer than four sub-apertures.

    Notes
    -----
    Spots that are not above the noise with 99.9 % confidence carry NO_FLUX: lost, their windows move with the
    neighbours'. Two spots nearer to each other than their FWHM cross: both carry UNLIKE_NEIGHBOURS, as spots
    whose displacement no neighbours continue. Spots at the edge of the frame carry AT_SEARCH_LIMIT.
    `search_range_px` counts from the expected position. A map of read noise is that of the unmoved windows.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16, origin=(32, 32), frame_shape=(176, 176))
    >>> y, x = np.mgrid[:176, :176]
    >>> def frame(shift_px):
    ...     squares = [(x - cx - shift_px) ** 2 + (y - cy) ** 2 for cx, cy in layout.centres]
    ...     return 100 * np.exp(-0.25 * np.array(squares)).sum(axis=0)
    >>> follower = fs.SpotFollower(fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=12)))
    >>> slopes = follower(np.array([frame(4.0 * step) for step in range(6)]))
    >>> print(slopes.x.mean(axis=1).round(2))
    [ 0.  4.  8. 12. 16. 20.]
    """

    def __init__(self, pipeline: SlopePipeline) -> None:
        layout = pipeline.binned_layout
        if layout.pitch_px is None or len(layout) < 4:
            raise InputError("spots to follow: expected a layout of at least 4 sub-apertures with pitch_px")
        self.pipeline = pipeline
        self._factor = pipeline.layout.bin
        self._pitch_px = layout.pitch_px
        self._maps = pipeline.light_test.maps
        self._zero = pipeline.plan.sensor.zero
        self._in_window = self._zero - np.rint(self._zero)
        self._images = self._of_images()
        self.plan = self._images.plan
        """Settings and tables by which the windows are measured."""
        self._light = MeanLight(
            self._images.binned_layout, self._images.light_test.maps, pipeline.plan.typical_fwhm_px
        )
        self._half = 0.5 * (np.array(layout.window[::-1]) - 1)
        middle = layout.corners[:, ::-1] + self._half + self._zero
        self._nodes: Complex = middle[:, 0] + 1j * middle[:, 1]
        self._neighbours = neighbours_of(layout.cells, layout.geometry)
        step = layout.pitch_px * np.exp(1j * np.radians(layout.angle_deg))
        self._lattice = Lattice(layout.geometry, complex(self._nodes[0]), complex(step))
        self._width_px: float | None = None
        self._expected: Complex | None = None
        self._usual = 0.0
        self.uncertain_frames = 0
        """Frames whose spots fit other lenslets nearly as well, so that none of their slopes is valid."""

    def _of_images(self) -> SlopePipeline:
        """Return the pipeline of windows that are already cut, calibrated, and centred on their spots."""
        given, layout = self.pipeline, self.pipeline.binned_layout
        psf, weights = given.spot
        reference = self._in_window - layout.offsets
        options: dict[str, Any] = {
            "psf": psf,
            "weights": weights,
            "width": given.width,
            "threads": given.threads,
        }
        return SlopePipeline(layout, *given.binned_parts, reference, **options).for_images()

    def __call__(self, frame: ArrayLike) -> Slopes:
        """Measure the next frame (h, w), or the next frames (n, h, w), in ADU.

        Raises
        ------
        InputError
            If a frame is not real or does not have the layout's shape.
        """
        array = self.pipeline.checked(frame)
        saturation = self.pipeline.calibration.saturation(array.dtype)
        measured = [self._next(one, saturation) for one in array.reshape(-1, *array.shape[-2:])]
        stacked = {name: np.stack([getattr(one, name) for one in measured]) for name in measured[0].variables}
        variables = scaled_positions(stacked, self._factor)
        if array.ndim == 2:
            variables = {name: values[0] for name, values in variables.items()}
        return Slopes.from_variables(variables, layout=self.pipeline.layout)

    def _next(self, frame: NDArray[Any], saturation: float) -> Slopes:
        """Measure the next frame, in binned pixels."""
        if self._factor > 1:
            frame = binned(frame, self._factor, saturation)
            saturation *= self._factor**2
        with np.errstate(over="ignore", invalid="ignore"):
            calibrated = (frame.astype(np.float32) - self._maps[0]) * self._maps[1]
            calibrated[~(np.abs(calibrated) <= LARGEST_FLOAT32)] = np.nan
            saturated = frame >= saturation
        if self._expected is None:
            expected, certain = self._start(calibrated)
        else:
            expected, certain = self._expected + self._common_motion(calibrated, self._expected), True
        slopes, at = self._measured(calibrated, saturated, expected)
        if not certain:
            self.uncertain_frames += 1
            doubtful = np.where(slopes.measured, np.uint8(SubapertureFlag.UNLIKE_NEIGHBOURS), np.uint8(0))
            return replace(slopes, flags=slopes.flags | doubtful)
        if self._is_lost(slopes.valid, at, expected):
            for bent in (False, True):
                again = self._acquired(calibrated, expected, bent=bent)
                if again is not None and again.certain:
                    start = again.completed(self._nodes, self._pitch_px)
                    other, other_at = self._measured(calibrated, saturated, start)
                    if np.count_nonzero(other.valid) > np.count_nonzero(slopes.valid):
                        slopes, at, expected = other, other_at, start
                if not self._is_lost(slopes.valid, at, expected):
                    break
        found = np.count_nonzero(slopes.valid)
        self._usual += (_WEIGHT if self._usual else 1.0) * (found - self._usual)
        self._expected = self._moved(expected, at, slopes.valid)
        return slopes

    def _start(self, calibrated: NDArray[np.float32]) -> tuple[Complex, bool]:
        """Return the displacements of a first frame, and whether no others are nearly as likely.

        Where most spots are too faint to be found anywhere, they are expected at their reference positions.
        """
        none = np.zeros_like(self._nodes)
        acquired = self._acquired(calibrated, none)
        if acquired is None:
            return none, True
        return acquired.completed(self._nodes, self._pitch_px), acquired.certain

    def _is_lost(self, valid: NDArray[np.bool_], at: Complex, expected: Complex) -> bool:
        """Return whether spots are missing, or all of them moved almost half a pitch."""
        if np.count_nonzero(valid) < _ENOUGH * self._usual:
            return True
        before = expected if self._expected is None else self._expected
        moved = np.abs(np.median((at - before)[valid])) if valid.any() else 0.0
        return bool(moved > _FAR * self._pitch_px)

    def _common_motion(self, calibrated: NDArray[np.float32], expected: Complex) -> complex:
        """Return by how much all spots moved together: where the mean of the windows is brightest [px]."""
        rows, columns = self._pixels(self._nodes + expected, calibrated.shape)
        images = np.nan_to_num(calibrated[rows, columns])
        bright = float(np.median(images.max(axis=(1, 2))))  # hot pixels count no more than a spot
        mean = np.minimum(images, bright).mean(axis=0)
        smooth = scipy.ndimage.gaussian_filter(mean, self._width_px or 1.0, mode="nearest")
        limit = np.median(smooth) + _CERTAIN * mad_std(smooth)
        y, x = np.unravel_index(np.argmax(smooth), smooth.shape)
        motion = complex(float(x) - self._half[0], float(y) - self._half[1])
        return motion if smooth[y, x] > limit and abs(motion) > _SMALL_PX else 0.0

    def _acquired(
        self, calibrated: NDArray[np.float32], expected: Complex, *, bent: bool = True
    ) -> Acquired | None:
        """Match all spots of a frame anew; return None if too few were found."""
        good = np.isfinite(calibrated)
        if not good.any() or np.ptp(calibrated[good]) == 0:
            return None
        image = SpotImage(np.where(good, calibrated, np.median(calibrated[good])).astype(np.float64))
        if self._width_px is None:
            fwhm_px = self.pipeline.plan.typical_fwhm_px
            self._width_px = spot_width(image, self._lattice) if fwhm_px is None else fwhm_px * FWHM_TO_STD
        spots = find_spots(image, self._lattice, self._width_px)
        nodes, shape = self._nodes, calibrated.shape
        acquired = acquire(spots, nodes, self._neighbours, self._pitch_px, shape, expected, bent=bent)
        enough = acquired is not None and np.count_nonzero(acquired.found) >= _FEWEST * len(nodes)
        return acquired if enough else None

    def _measured(
        self, calibrated: NDArray[np.float32], saturated: NDArray[np.bool_], expected: Complex
    ) -> tuple[Slopes, Complex]:
        """Return the slopes in windows around the expected spots, and the displacements."""
        layout = self.pipeline.binned_layout
        n, (ny, nx) = len(layout), layout.window
        spots = self._nodes + expected
        rows, columns = self._pixels(spots, calibrated.shape)
        corners = np.column_stack([columns[:, 0, 0], rows[:, 0, 0]])
        images = calibrated[rows, columns]
        self._hide_others(images, rows, columns, spots)
        stack = images.reshape(n * ny, nx)
        slopes = self._images(stack)
        flags = slopes.flags.copy()
        flags[saturated[rows, columns].any(axis=(1, 2))] |= np.uint8(SubapertureFlag.SATURATED)
        flags[self._light.significances(stack) < 1.0] |= np.uint8(SubapertureFlag.NO_FLUX)
        measured = (flags & UNMEASURED) == 0
        at = corners + self._half + self._in_window + np.stack([slopes.x, slopes.y], axis=1)
        displacements = at[:, 0] + 1j * at[:, 1] - self._nodes
        x, y = (np.where(measured, part, 0.0).astype(np.float32) for part in as_rows(displacements).T)
        self._flag_unlike(x, y, slopes.flux, flags)
        crossing = self._crossing(spots) | self._crossing(self._nodes + displacements, measured)
        flags[crossing & measured] |= np.uint8(SubapertureFlag.UNLIKE_NEIGHBOURS)
        errors: dict[str, Any] = {
            f"standard_error_{axis}": np.where(measured, getattr(slopes, f"standard_error_{axis}"), np.inf)
            for axis in "xy"
        }
        return replace(slopes, x=x, y=y, flags=flags, **errors), displacements

    def _pixels(self, spots: Complex, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return rows (n, ny, 1) and columns (n, 1, nx) of windows around spots, moved into the frame."""
        ny, nx = self.pipeline.binned_layout.window
        corners = np.rint(as_rows(spots) - self._half).astype(np.int64)
        corners = np.clip(corners, 0, [shape[1] - nx, shape[0] - ny])
        return corners[:, 1, None, None] + np.arange(ny)[:, None], corners[:, 0, None, None] + np.arange(nx)

    def _hide_others(
        self, images: NDArray[np.float32], rows: NDArray[Any], columns: NDArray[Any], spots: Complex
    ) -> None:
        """Replace the pixels that are nearer to another spot than to the window's own by its median."""
        reach = 0.5 * np.array(images.shape[:0:-1]) + 2.0 * (self._width_px or 1.0)
        scaled = as_rows(spots) / reach
        pairs = scipy.spatial.cKDTree(scaled).query_pairs(1.0, p=np.inf, output_type="ndarray")
        first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
        pixels = columns[first] + 1j * rows[first]
        nearer = np.abs(pixels - spots[second, None, None]) < np.abs(pixels - spots[first, None, None])
        hidden = np.zeros(images.shape, bool)
        np.logical_or.at(hidden, first, nearer)
        for index in np.unique(first).tolist():
            kept = images[index][~hidden[index]]
            images[index][hidden[index]] = np.nanmedian(kept) if np.isfinite(kept).any() else 0.0

    def _flag_unlike(self, x: Any, y: Any, flux: Any, flags: NDArray[np.uint8]) -> None:
        """Flag displacements that no neighbours continue, at any distance from the reference positions."""
        expected = self.pipeline.plan.expected
        anywhere = expected._replace(edge=np.full_like(expected.edge, np.inf))
        arrays = (np.ascontiguousarray(array[None]) for array in (x, y, flux))
        flag_doubtful(*arrays, flags[None], anywhere, np.empty(doubtful_scratch_size(len(flags)), np.float32))

    def _crossing(self, spots: Complex, used: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Return which of the used spots are so near to each other that they cannot be told apart."""
        apart = max(_LEAST_APART_PX, (self._width_px or 0.0) / FWHM_TO_STD)
        index = np.arange(len(spots)) if used is None else np.flatnonzero(used)
        crossing = np.zeros(len(spots), bool)
        if len(index) > 1:
            tree = scipy.spatial.cKDTree(as_rows(spots[index]))
            crossing[index[tree.query_pairs(apart, output_type="ndarray")]] = True
        return crossing

    def _moved(self, expected: Complex, at: Complex, valid: NDArray[np.bool_]) -> Complex:
        """Return where to expect the spots of the next frame: neighbours move alike."""
        if np.count_nonzero(valid) < 4:
            return expected
        motion = at - expected
        alike = FollowedDrift(self._nodes[valid], motion[valid], self._pitch_px)(self._nodes)
        own = np.where(valid, _OWN * (motion - alike), 0.0)
        most = _MOST_OWN * self._pitch_px
        return np.asarray(expected + alike + own * np.minimum(1.0, most / np.maximum(np.abs(own), 1e-9)))
