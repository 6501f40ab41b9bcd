"""Test whether sub-apertures have any flux, and the running mean of the flux of faint frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, not_none, number_between, numbers_between, real_array
from faintspot.slopes.kernels.gather import Frames
from faintspot.slopes.kernels.host import WIDTHS, lanes_for
from faintspot.slopes.kernels.validity.dark import MOST_LANES, LightTest, scratch_size, significances
from faintspot.slopes.sensor.layout import Layout

FALSE_LIGHT = 1e-3
"""Probability that a window without any flux passes."""
_FEWEST_PX = 4  # of a window's side: below, as in quad cells, nothing in it is far from the spot
_LEAST_BOX_PX = 3
_BOX_OF_FWHM = 1.25  # of a Gaussian spot in white noise: nearly the most significant box
_BOXES = 8.0  # independent ones in the area of one box: at most one for each pixel
_MEDIAN_OF_FOUR = 0.2982  # variance of the median of four normal deviates


def light_test(
    layout: Layout, maps: NDArray[np.float32], fwhm_px: float | None, *, boxes: int = 1
) -> LightTest:
    """Return the test of a sensor's windows.

    Parameters
    ----------
    layout : Layout
    maps : (2, h, w) float32
        Dark and electrons per ADU of each pixel of a frame, NaN in bad ones.
    fwhm_px : float, optional
        Width of the spots, if it is known.
    boxes : int
        Number of tests, of boxes of several sizes, of which a dark window passes none.
    """
    ny, nx = layout.window
    box = box_px(layout.window, fwhm_px)
    limit, unit = 0.0, 1.0
    if box:
        trials = min(_BOXES / box**2, 1.0) * ny * nx * boxes
        limit = NormalDist().inv_cdf((1.0 - FALSE_LIGHT) ** (1.0 / trials))
        unit = math.sqrt(box**2 + _MEDIAN_OF_FOUR * box**4 / (0.5 * (ny + nx)))
    most = min(max(nx, min(WIDTHS)), MOST_LANES)
    lanes = lanes_for(np.float32, max(width for width in WIDTHS if width <= most))
    last = np.zeros(lanes.width, np.float32)
    last[lanes.width - nx % lanes.width :] = 1.0
    corners, numbers = np.ascontiguousarray(layout.corners), (np.float32(limit), np.float32(unit))
    none = np.zeros(0, np.int64)
    return LightTest(lanes, last, np.ascontiguousarray(maps), corners, (ny, nx), box, *numbers, none)


class MeanLight:
    """Test of the windows of mean images: of many frames, or of those so far.

    Spots that move are wider in the mean: a window is dark if nothing shows in the box of a spot, nor in one
    twice as wide.

    Parameters
    ----------
    layout, maps, fwhm_px
        As for `light_test`.
    """

    def __init__(self, layout: Layout, maps: NDArray[np.float32], fwhm_px: float | None) -> None:
        usual = box_px(layout.window, fwhm_px)
        self._n, self._window = len(layout), layout.window
        self._tests = [
            light_test(layout, maps, box / _BOX_OF_FWHM, boxes=2) for box in (usual, 2 * usual + 1) if usual
        ]

    def significances(self, mean: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return the significance of each window's flux in a mean frame (h, w) [ADU], (n,), over the limit.

        It is below 1 in dark windows, and infinite in windows too small for a test. NaN marks pixels without
        any value.
        """
        frames = Frames.of(np.ascontiguousarray(mean, np.float32)[None])
        scratch = np.empty(scratch_size(*self._window), np.float32)
        largest, found = np.zeros(self._n, np.float32), np.empty(self._n, np.float32)
        for test in self._tests:
            significances(test, frames, found, scratch)
            np.maximum(largest, found / test.limit, out=largest)
        return largest if self._tests else np.full(self._n, np.inf, np.float32)


def box_px(window: tuple[int, int], fwhm_px: float | None) -> int:
    """Return the side of the box of pixels that holds most of a spot: odd; 0 in windows too small for one."""
    side = min(window)
    if side < _FEWEST_PX:
        return 0
    wanted = _LEAST_BOX_PX
    if fwhm_px is not None:
        wanted = max(2 * round((_BOX_OF_FWHM * fwhm_px - 1) / 2) + 1, _LEAST_BOX_PX)
    most = side // 2
    return max(1, min(wanted, most - (most + 1) % 2))


_LEAST_FLUX_E = 1e-3


@dataclass(frozen=True, eq=False)
class MeanFlux:
    """Mean flux of each sub-aperture over the previous frames; an immutable value, updated frame by frame.

    ::

        light = fs.MeanFlux(first_frames_slopes.flux)
        for frame in frames:
            slopes = pipeline.with_flux(light)(frame)
            light = light.updated(slopes.flux)

    Parameters
    ----------
    flux_e : (n,) or (n_frames, n) array
        Flux [electrons] of one frame, or of several, which are averaged.
    time_constant_frames : float
        Number of frames after which the weight of a frame has decreased by a factor of e. The first frames,
        up to this number, are weighted equally.
    frames : float
        Number of frames averaged in `flux_e` (n,). Default: 1, or the number of frames given.

    Raises
    ------
    InputError
        If flux is not finite or of another shape, or a number is out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> light = fs.MeanFlux([100.0, 40.0])
    >>> print(light.updated([110.0, 60.0]).flux_e)
    [105.  50.]
    """

    flux_e: Any
    time_constant_frames: float = 1000.0
    frames: float | None = None

    def __post_init__(self) -> None:
        flux = numbers_between("flux_e", self.flux_e, -1e12, 1e12)
        check_shape("flux_e", flux, ("n",), ("n_frames", "n"))
        number_between("time_constant_frames", self.time_constant_frames, 1.0)
        count = 1 if flux.ndim == 1 else len(flux)
        frames = number_between("frames", count if self.frames is None else self.frames, 0.0, low_open=True)
        mean = flux if flux.ndim == 1 else flux.mean(axis=0)
        mean.flags.writeable = False
        object.__setattr__(self, "flux_e", mean)
        object.__setattr__(self, "frames", float(frames))

    def updated(self, flux_e: ArrayLike) -> MeanFlux:
        """Return the mean updated by a frame's flux (n,) [electrons]; values that are not finite are ignored.

        Raises
        ------
        InputError
            If the number of sub-apertures differs.
        """
        flux = real_array("flux_e", flux_e)
        check_shape("flux_e", flux, self.flux_e.shape)
        frames = min(not_none(self.frames) + 1.0, self.time_constant_frames)
        change = np.where(np.isfinite(flux), flux - self.flux_e, 0.0) / frames
        return replace(self, flux_e=self.flux_e + change, frames=frames)

    @property
    def positive_flux_e(self) -> NDArray[np.float64]:
        """Mean flux, at least 0.001 electrons."""
        flux: NDArray[np.float64] = np.maximum(self.flux_e, _LEAST_FLUX_E)
        return flux
