"""Common parts of the adapters: layouts from a tool's lenslets, slopes in its unit, checks of its input."""

import functools
import importlib.metadata
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, finite_array, not_none, number_between, real_array
from faintspot.base.errors import InputError
from faintspot.base.text_files import check_keys
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.pipeline.light import MeanFlux
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, SMALLEST_WINDOW
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

CALIBRATION_FLUX_E = 1000.0
"""Flux of a sub-aperture [electrons] at which noise-free frames are measured."""
FLUX_FRAMES = 1000.0
"""Time constant of the mean flux [frames]."""
_FIRST_FRAMES = 20  # averaged before the mean flux is used: one faint frame is too noisy
_FOLLOW_EVERY = 10  # frames
_LEAST_FLUX_E = 1e-3
_PARTS = "estimator", "settings", "calibration", "psf", "weights"
_EXACT_PX = 1e-6  # rounding error of a centre


def largest_window(centres: ArrayLike) -> int:
    """Return the side of the largest square windows around lenslets that do not overlap [px].

    Parameters
    ----------
    centres : (n, 2) array
        x, y of every lenslet's centre, px.

    Raises
    ------
    InputError
        When there are fewer than two lenslets, or their spacing is below the smallest window.
    """
    from scipy.spatial import cKDTree

    array = finite_array("lenslet centres", centres, minimum_dimensions=2)
    if len(array) < 2:
        raise InputError("pixels: expected the window's side for a single lenslet, got none")
    apart = float(np.min(cKDTree(array).query(array, k=2, p=np.inf)[0][:, 1]))
    side = int(np.floor(apart + _EXACT_PX))
    if side < SMALLEST_WINDOW:
        raise InputError(f"lenslets: expected at least {SMALLEST_WINDOW} px between centres, got {apart:.3g}")
    return min(side, LARGEST_WINDOW)


def window_corners(centres: ArrayLike, side: int) -> NDArray[np.int64]:
    """Return row and column of the first pixel of the window of `side` pixels nearest each centre: (n, 2).

    Windows are whole pixels; the remaining offsets of the centres are in `Layout.offsets`.
    """
    array = np.round(finite_array("lenslet centres", centres, minimum_dimensions=2), 6)
    return np.floor(array[:, ::-1] - 0.5 * (side - 1) + 0.5).astype(np.int64)


def on_detector(centres: ArrayLike, frame_shape: tuple[int, int], side: int) -> NDArray[np.bool_]:
    """Return whether each lenslet's whole window is on the detector: (n,) bool."""
    corners = window_corners(centres, side)
    return np.all((corners >= 0) & (corners + side <= np.array(frame_shape)), axis=1)  # type: ignore[no-any-return]


def layout_around(centres: ArrayLike, frame_shape: tuple[int, int], side: int) -> Layout:
    """Return the layout of windows around lenslets.

    Parameters
    ----------
    centres : (n, 2) array
        x, y of each lenslet's centre in frame pixels (pixel i has its centre at i). Positions are measured
        from there, even if it is not the centre of a window.
    frame_shape : (int, int)
        Height and width of a frame.
    side : int
        Side of each window, pixels.

    Raises
    ------
    InputError
        As for `Layout`.
    """
    corners = window_corners(centres, side)
    return Layout(frame_shape, (side, side), corners, finite_array("lenslet centres", centres))


def parts_of(source: str | Path | Mapping[str, object]) -> Configuration:
    """Return the pipeline's parts from a tool's configuration.

    Parameters
    ----------
    source : path or mapping
        A faintspot.toml, or its tables `estimator`, `settings`, `calibration`, `psf` and `weights` as
        mappings, with file names relative to the working directory.

    Raises
    ------
    InputError
        When a table or key is unknown, a value is invalid, or a file cannot be read.
    """
    if isinstance(source, str | Path):
        return Configuration(source)
    if isinstance(source, Mapping):
        check_keys("faintspot: ", source, _PARTS, what="table")
        return Configuration("faintspot", source)
    raise InputError(f"faintspot: expected a file or tables of settings, got {type(source).__name__}")


class PipelineOptions(TypedDict, total=False):
    """Options that `ToolSlopes` passes on to `faintspot.SlopePipeline`."""

    psf: PSF | None
    weights: FixedWeights | None
    threads: int | None


class AdapterOptions(PipelineOptions, total=False):
    """Options that every adapter passes on to `ToolSlopes`."""

    calibration_flux_e: float
    flux_frames: float | None


class ToolSlopes:
    """A slope pipeline inside another tool: slopes in the tool's unit, calibration, prior and flux.

    Parameters
    ----------
    layout : Layout
    settings : Settings
    calibration : Calibration, optional
        Default: images are in electrons.
    unit_per_px : (2,) array
        The tool's unit per pixel along x and y; negative if its axis is opposite to the frame's.
    calibration_flux_e : float
        Mean flux of a sub-aperture, electrons, at which noise-free frames are measured.
    flux_frames : float, optional
        Time constant (frames) of the running mean of the flux for estimators that use it, if the settings
        have no `flux_e`; begins after 20 frames. None: the flux is that of each frame.
    **options
        psf, weights and threads; see `faintspot.SlopePipeline`.

    Raises
    ------
    InputError
        As for the pipeline, and when a number is out of range.
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        calibration: Calibration | None = None,
        *,
        unit_per_px: ArrayLike = (1.0, 1.0),
        calibration_flux_e: float = CALIBRATION_FLUX_E,
        flux_frames: float | None = FLUX_FRAMES,
        **options: Unpack[PipelineOptions],
    ) -> None:
        self.pipeline = SlopePipeline(layout, settings, calibration, **options)
        self.unit_per_px = finite_array("unit_per_px", unit_per_px).astype(np.float64).reshape(2, 1)
        self._flux_e = _checked_flux(calibration_flux_e)
        if flux_frames is not None:
            number_between("flux_frames", flux_frames, 1.0)
        known = not np.isnan(self.pipeline.plan.sensor.flux_e).any()
        follows = flux_frames is not None and settings.estimator.uses_flux and not known
        self._flux_frames = flux_frames if follows else None
        self._first_flux: list[NDArray[np.float32]] = []
        self._flux: MeanFlux | None = None
        self._frames = 0
        self.noise_free = False
        """Whether frames are noise-free calibration frames, as in `calibrating`."""
        self._bright: SlopePipeline | None = None
        self._last: Slopes | None = None

    def measure(
        self, frame: Any, *, prior_px: ArrayLike | None = None, noise_free: bool = False
    ) -> NDArray[np.float64]:
        """Return x and y slopes of a frame (h, w) in the tool's unit: (2, n).

        Parameters
        ----------
        frame : (h, w) array
        prior_px : (n, 2) or (2 n,) array, optional
            Predicted slopes, as for `faintspot.SlopePipeline`.
        noise_free : bool
            Whether the frame is a noise-free calibration frame, to be measured as in `calibrating`.

        Raises
        ------
        InputError
            As for the pipeline, and when a calibration frame has no flux or no slopes.
        """
        if noise_free or self.noise_free:
            self._last = self._calibrated(frame)
        else:
            self._last = self.pipeline(frame, prior_px)
            if self._flux_frames is not None:
                self._follow(self._last.flux)
        return np.stack([self._last.x, self._last.y], dtype=np.float64) * self.unit_per_px

    @contextmanager
    def calibrating(self, flux_e: float | None = None) -> Iterator[None]:
        """Measure noise-free frames, e.g. for interaction matrices and references, in a `with` block.

        Frames are scaled to `flux_e` electrons per sub-aperture (default: `calibration_flux_e`) and measured
        without a prior and without noise handling. At the flux of a faint star, denoising would flatten the
        spots; at very high flux, noise models no longer hold.

        Raises
        ------
        InputError
            When the flux is not positive.
        """
        before = self.noise_free, self._flux_e
        self.noise_free, self._flux_e = True, self._flux_e if flux_e is None else _checked_flux(flux_e)
        try:
            yield
        finally:
            self.noise_free, self._flux_e = before

    @property
    def last(self) -> Slopes:
        """Last measurement, in pixels, with flags and flux.

        Raises
        ------
        InputError
            When nothing has been measured yet.
        """
        if self._last is None:
            raise InputError("last slopes: no image has been measured yet; measure one first")
        return self._last

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """Standard errors of the last slopes in the tool's unit, (2, n); infinite where unknown."""
        in_px = np.stack([self.last.standard_error_x, self.last.standard_error_y], dtype=np.float64)
        return in_px * np.abs(self.unit_per_px)

    def recorded(self, slopes: ArrayLike) -> NDArray[np.float64]:
        """Return the tool's slopes of the last frame for a recording: NaN where they were not measured.

        The tool itself gets 0 there, or its reference, as it can do nothing with NaN.

        Parameters
        ----------
        slopes : (2 n,) or (2, n) array
            x and y one after the other, in either order.
        """
        array = real_array("slopes", slopes)
        measured = self.last.measured
        if array.size != 2 * len(measured):
            raise InputError(f"slopes: expected {2 * len(measured)} of the last frame, got {array.size}")
        return np.where(np.tile(measured, 2), array.ravel(), np.nan)

    @property
    def flux(self) -> MeanFlux | None:
        """Running mean of the flux; None before it is available."""
        return self._flux

    def _follow(self, flux_e: NDArray[np.float32]) -> None:
        """Add a frame's flux to the mean; rebuild the pipeline only now and then."""
        self._frames += 1
        if self._flux is not None:
            self._flux = self._flux.updated(flux_e)
        elif self._frames < _FIRST_FRAMES:
            self._first_flux.append(flux_e)
        else:
            self._flux = MeanFlux(np.array([*self._first_flux, flux_e]), not_none(self._flux_frames))
            self._first_flux.clear()
        if self._flux is not None and self._frames % _FOLLOW_EVERY == 0:
            self.pipeline = self.pipeline.with_flux(self._flux)

    def _calibrated(self, frame: object) -> Slopes:
        """Measure a noise-free frame at the calibration flux."""
        pipeline, calibration = self.pipeline, self.pipeline.calibration
        layout = pipeline.layout
        array = finite_array("calibration frame", frame)
        check_shape("calibration frame", array, layout.frame_shape)
        dark, e_per_adu = calibration.maps(layout.frame_shape)
        images = layout.images((array - dark) * e_per_adu)
        flux = np.nansum(images, axis=(1, 2))
        if not flux.mean() > 0.0:
            raise InputError(
                f"calibration frame: expected flux in the sub-apertures, got {flux.mean():.3g} e- on "
                "average; check the source and the calibration's dark"
            )
        factor = self._flux_e / flux.mean()
        if self._bright is None:
            settings = pipeline.settings
            bright = settings.replace(estimator=settings.estimator.for_bright_flux(), flux_e=None)
            self._bright = pipeline.with_settings(bright).for_images()
        if self._bright.settings.estimator.uses_flux:
            self._bright = self._bright.with_flux(np.maximum(flux * factor, _LEAST_FLUX_E))
        slopes = self._bright((images * factor).reshape(-1, layout.window[1]))
        found = int(np.count_nonzero(slopes.valid))
        if 2 * found < len(layout):
            raise InputError(
                f"calibration frame: expected slopes of {len(layout)} sub-apertures, got {found}; check that "
                "spots are within their windows and search_range_px, or give another calibration_flux_e"
            )
        return slopes


def _checked_flux(flux_e: float) -> float:
    return number_between("calibration_flux_e", flux_e, 0.0, 1e9, low_open=True)


class UntestedVersionWarning(UserWarning):
    """Warning for another version of a tool than its adapter was tested with."""


@functools.cache
def check_version(tool: str, distribution: str, tested: str) -> None:
    """Warn once if a tool's version is not the one that its adapter was tested with.

    Parameters
    ----------
    tool, distribution : str
        Name of the tool, and of its installed distribution.
    tested : str
        Tested version.
    """
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return  # used from source: its version is not known
    if _numbers(version) != _numbers(tested):
        warnings.warn(
            f"{tool} {version}: faintspot's adapter was tested with {tested}; compare its slopes with "
            f"{tool}'s own before you rely on them",
            UntestedVersionWarning,
            stacklevel=3,
        )


def _numbers(version: str) -> tuple[int, ...]:
    """Return major, minor and patch version."""
    found = [int(number) for number in re.findall(r"\d+", version)[:3]]
    return tuple(found + [0] * (3 - len(found)))


def check_matrix(name: str, matrix: ArrayLike) -> NDArray[np.generic]:
    """Return an interaction or control matrix after checking that it is usable.

    Raises
    ------
    InputError
        When it has NaN or infinite numbers, or only zeros, e.g. after a failed calibration.
    """
    array = real_array(name, matrix, minimum_dimensions=2)
    bad = array.size - int(np.count_nonzero(np.isfinite(array)))
    if bad or not array.any():
        got = f"{bad} NaN or infinite of {array.size}" if bad else "zeros only"
        raise InputError(
            f"{name}: expected finite numbers that are not all 0, got {got}; calibrate again with noise-free "
            "frames that illuminate every sub-aperture"
        )
    return array


def predicted(
    predict: object, last: NDArray[np.generic] | None, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """Return the slopes that a tool's loop predicts for the next frame, in the tool's unit and order.

    Parameters
    ----------
    predict : callable or object with `predict`, optional
        Takes the last slopes. If it is None or returns None, there is no prediction.
    last : array, optional
        Last slopes; None before the first frame, when there is no prediction.
    shape : tuple of int
        Shape of the slopes.

    Raises
    ------
    InputError
        When the object cannot be called, or the slopes have another shape.
    """
    if predict is None:
        return None
    call = getattr(predict, "predict", predict)
    if not callable(call):
        raise InputError(f"predict: expected a callable or an object with predict(slopes), got {predict!r}")
    value = None if last is None else call(last)
    if value is None:
        return None
    array = real_array("predict", value)
    if array.size != int(np.prod(shape)):
        raise InputError(f"predict: expected slopes of shape {shape}, got {array.shape}")
    return array.astype(np.float64).reshape(shape)
