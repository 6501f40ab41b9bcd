"""Settings to begin with, from the flux, noise, spot width and displacements that a few frames show."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.statistics import FWHM_TO_STD
from faintspot.slopes.camera.calibration import Calibration, binned, binned_calibration
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.estimators.centroid import SeenSpots, like_most, seen_spots
from faintspot.slopes.estimators.noise import pixel_noise
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.binning import binned_layout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.region import neighbour_vectors, neighbours_of
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW
from faintspot.slopes.spots.psf import PSF

_FEWEST_PX = 4  # of a window's side; below, as in quad cells, every pixel counts
_WIDTH_OF_WINDOW = 0.25  # of the window's side, where no spot is seen
_LEAST_NOISE, _LARGEST_GAIN = 1e-6, 100.0  # noise over flux; of `Window.centroid_gain`
ASSUMED_NOISE_E = 3.0  # of a dark pixel, which gives the gain of a single frame
_WEIGHTS = (1.25, 1.6)  # width of the weight over the spot's: best where read noise, photon noise dominates
# Likewise where spots overlap (width over the pitch), and where they are sharper than Nyquist sampling.
_OVERLAPPING, _WIDEST, _NARROW_WEIGHTS = 0.35, 0.75, (0.25, 0.35, 0.5, 0.7, 0.9)
_SHARP_PX, _WIDE_WEIGHTS = 2.2, (2.5, 4.0, 6.0)
WIDEST_PX = LARGEST_WINDOW / _WEIGHTS[-1]
"""Full width at half maximum of spots whose widest weight fills the largest window."""
# Systematic error accepted if any weight reaches it, at most that part of the least error with noise; and the
# one that is doubtful.
_SYSTEMATIC_PX, _OF_ERROR, _DOUBTFUL_PX = 0.015, 0.1, 0.03
_BEFORE_FITS_PX = 0.025  # error of all weights from which on fits are tried, which rely on the spots' shape
_MOVED = 0.125  # of the window's side: displacements to have it for, from half a pixel to one
_WIDER = np.geomspace(1.0, 2.5, 48)  # widths tried of spots that hide each other's wings, over the seen one
_MORE_STEPS = 8  # of fits of sharp spots: three do not always reach the maximum
_WINDOWS = (1.0, 1.5, 2.2, 3.2)  # width of a fixed window over the spot's: wide where spots move far
_LEAST_RESPONSE = 0.05  # below, the displacements are not known well enough to choose the width
_LEAST_DISPLACEMENT = 0.15  # rms over the spot's width: frames to come may move more than static ones
_TIGHT = 3.0  # search range over the rms displacement
_LEAST_RANGE_PX = 1.0
# Predicted error with a tight search range over that in the whole window, to take the tight one: frames to
# come may be aberrated where these are flat.
_BETTER = 0.8
# Response below which a fixed window is tried, and its error over the best one; also of sharp spots, whose
# slopes in a fixed window depend on their place in the pixel.
_FAINT, _AS_GOOD, _MUCH_BETTER = 0.8, 1.1, 0.5
_SPOTS, _PHASES = 512, 128
_GOLDEN = np.array([0.8567, 0.7339, 0.6287, 0.5386])  # of a sequence that fills four dimensions evenly
_INTO_PUPIL = np.exp(0.35j)  # direction from its edge, not along a row
_SHARPEST_PX = 0.1  # standard deviation of a spot before its pixels blur it


@dataclass(frozen=True)
class FirstSettings:
    """Settings to begin with, and the noise and flux from which they follow, in the frames' unit.

    Parameters
    ----------
    settings : Settings
    noise : float
        Standard deviation of a pixel far from the spots.
    flux : float
        Of a spot in a frame; 0 where no spots are seen.
    response : float
        Slope shown for a displacement of 1 px; below 1 where slopes would else be worse than none.
    psf : mapping, optional
        Table [psf] of the configuration, where the settings need it.
    systematic_px : float, optional
        Largest systematic error of a spot displaced by up to 1 px (an eighth of smaller windows), wherever it
        lies in its pixel and with its neighbours' flux: the S-curve left by the settings [px]. None where the
        flux is too low for full slopes, infinite where spots are wider than 0.75 of the pitch.
    at_edge_px : float
        Constant error of a spot at the pupil's edge, where neighbours are missing [px].
    """

    settings: Settings
    noise: float
    flux: float
    response: float = 1.0
    psf: dict[str, Any] | None = None
    systematic_px: float | None = None
    at_edge_px: float = 0.0
    fwhm_px: float = math.nan

    @property
    def doubt(self) -> str:
        """Why the slopes may be wrong, in one line; empty if they are not."""
        if not (self.systematic_px or 0.0) > _DOUBTFUL_PX:
            return ""
        remedy = "smaller spots or a larger pitch"
        if math.isinf(self.systematic_px or 0.0):
            return (
                "spots are wider than 0.75 of the pitch, or there is much even light: systematic errors are "
                f"not known; {remedy}, or --dark, would help"
            )
        if self.fwhm_px < _SHARP_PX:
            remedy = "spots of 1.2 px or more, by less binning or focus"
        return (
            f"no settings measure spots of {self.fwhm_px:.2g} px wherever they lie in their pixels: "
            f"systematic errors up to {self.systematic_px:.2g} px; {remedy} would help"
        )


def first_settings(layout: Layout, calibration: Calibration, frames: NDArray[np.generic]) -> FirstSettings:
    """Choose settings from a few frames of typical flux; they follow the unit of the frames.

    Spots of the width, flux, noise and displacements that the frames show are simulated. The settings of the
    smallest slope error are taken: a centre of gravity under a weight that follows the spot or, where the
    flux is too low for that, under a fixed window, with slopes reduced to those of least squares. In windows
    narrower than 4 px it is the plain centre of gravity. Lenslets with reflections or other structures that
    are no spots do not count.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
    frames : (n, h, w) array, ADU
        Two or more show the photon noise; of a single one it is assumed.

    Returns
    -------
    FirstSettings
    """
    if (factor := layout.bin) > 1:
        camera = binned_calibration(calibration, factor, layout.frame_shape)
        seen = first_settings(binned_layout(layout), camera, binned(frames, factor))
        return replace(seen, settings=seen.settings.magnified(factor))
    calibrated = SlopePipeline(layout, Settings("brightest"), calibration).explain(frames).calibrated
    images: Floats = calibrated.astype(np.float64)
    noise = pixel_noise(images)
    if min(layout.window) < _FEWEST_PX:
        sums = images.sum(axis=(-2, -1))
        return FirstSettings(Settings("centroid"), noise, max(float(np.median(sums)), 0.0))
    usual = like_most(images)
    images, layout = images[:, usual], layout[usual]
    spots = _seen(images)
    if spots is None:
        side = _rounded(_WIDTH_OF_WINDOW * min(layout.window))
        unseen = Settings(
            "window", spot_fwhm_px=side, centroid_gain=_LARGEST_GAIN, search_range_px=_LEAST_RANGE_PX
        )
        return FirstSettings(unseen, noise, 0.0, 0.0)
    noise = max(noise, _LEAST_NOISE * spots.flux)
    trial = _Trial(images, layout, noise, spots)
    settings, response = trial.best()
    psf = trial.psf if Need.PSF in settings.estimator.needs else None
    systematic, at_edge = trial.systematic(settings) if response == 1 else (None, 0.0)
    flux, fwhm = trial.spots.flux, trial.fwhm_px
    return FirstSettings(settings, noise, flux, response, psf, systematic, at_edge, fwhm)


def _seen(images: Floats) -> SeenSpots | None:
    """Return width and flux of the spots; of the mean frame where those of single frames are lost."""
    for shown in (images, images.mean(axis=0)):
        try:
            return seen_spots(shown)
        except InputError:
            pass
    return None


def _displacement(images: Floats, layout: Layout, spots: SeenSpots) -> float:
    """Return how far spots are from their references, rms of both axes, however faint they are.

    Displacements widen the mean of all images, and not their autocorrelation.
    """
    mean = images.mean(axis=(0, 1))
    mean = mean - np.median(mean[[0, -1]])
    try:
        wide = seen_spots(mean)
    except InputError:
        return _WIDTH_OF_WINDOW * min(layout.window)
    squares = np.square([wide.fwhm_x_px, wide.fwhm_y_px]) - np.square([spots.fwhm_x_px, spots.fwhm_y_px])
    v, u = (np.arange(side) - 0.5 * (side - 1) for side in layout.window)
    spot = np.maximum(mean - 0.5 * mean.max(), 0.0)
    middle = np.array([u @ spot.sum(axis=0), v @ spot.sum(axis=1)]) / spot.sum()
    squares_away = np.square(middle - layout.offsets.mean(axis=0)) - layout.offsets.var(axis=0)
    return math.sqrt(max(float((squares * FWHM_TO_STD**2 + squares_away).mean()), 0.0))


def _photon_noise(images: Floats, noise: float, flux: float) -> float:
    """Return the variance that flux adds, over the flux: at most what successive frames differ by."""
    if len(images) == 1:
        return noise / ASSUMED_NOISE_E
    squares = 0.5 * np.square(np.diff(images, axis=0)).sum(axis=(-2, -1))
    pixels = images.shape[-2] * images.shape[-1]
    return float(max(np.median(squares) - pixels * noise**2, 0.0) / flux)


def _centred(image: Floats) -> Floats:
    """Return an image moved by a spline so that the middle of what is above half its height is central."""
    above = np.maximum(image - 0.5 * (image.max() + np.median(image)), 0.0)
    middle = np.array(scipy.ndimage.center_of_mass(above)) if above.any() else np.zeros(2)
    return np.asarray(scipy.ndimage.shift(image, 0.5 * (np.array(image.shape) - 1) - middle, mode="mirror"))


class _Trial:
    """Settings tried on simulated spots like those of the frames."""

    def __init__(self, images: Floats, layout: Layout, noise: float, spots: SeenSpots) -> None:
        rng = np.random.default_rng(1)
        self.spots, self._window, self._noise = spots, layout.window, noise
        self._displacement = max(_displacement(images, layout, spots), _LEAST_DISPLACEMENT * self.fwhm_px)
        self._truth = self._displacement * rng.standard_normal((_SPOTS, 2))
        self._pitch_px, self._is_hidden = layout.pitch_px or math.inf, False
        overlap = self.fwhm_px > _OVERLAPPING * self._pitch_px
        self._around = np.zeros(0, complex)
        if overlap:
            self._around = neighbour_vectors(layout.geometry, self._pitch_px, layout.angle_deg)
        inwards = np.exp(2j * np.pi * rng.random(_SPOTS))
        inwards[::2] = 0
        if overlap:
            self.spots = self._widened(images, layout)
        mean = self._spots_at(self._truth, inwards)
        variance = noise**2 + _photon_noise(images, noise, spots.flux) * mean
        self._images = mean + np.sqrt(variance) * rng.standard_normal(mean.shape)
        half = min(max(_MOVED * min(layout.window), 0.5), 1.0)
        places = np.arange(_PHASES)[:, None] * _GOLDEN % 1 - 0.5
        inwards = np.repeat([0, _INTO_PUPIL] if overlap else [0], _PHASES)
        self._references, moved = (np.tile(xy, (len(inwards) // _PHASES, 1)) for xy in np.split(places, 2, 1))
        self._moved = 2 * half * moved
        self._moved_images = self._spots_at(self._references + self._moved, inwards)
        self._weights = (*(_NARROW_WEIGHTS if overlap else ()), *_WEIGHTS)
        self._is_sharp = self.fwhm_px < _SHARP_PX
        if self._is_sharp:
            self._weights += _WIDE_WEIGHTS

    @property
    def fwhm_px(self) -> float:
        """Full width at half maximum of the spots, with the blur of the pixels."""
        return math.sqrt(self.spots.fwhm_x_px * self.spots.fwhm_y_px)

    def _widened(self, images: Floats, layout: Layout) -> SeenSpots:
        """Return the spots whose sum with their neighbours is most like the images amid the pupil.

        The background is that of the calibration or constant; an even light looks like wide spots.
        """
        inner = (neighbours_of(layout.cells, layout.geometry, diagonal=True) < len(layout)).all(axis=1)
        shown = images.mean(axis=0)[inner | ~inner.any()]
        shown = np.stack([_centred(image) for image in shown]).mean(axis=0).ravel()
        seen, widths = self.spots, []
        for terms in (1, 2):
            fits = []
            for factor in _WIDER:
                self.spots = SeenSpots(factor * seen.fwhm_x_px, factor * seen.fwhm_y_px, seen.flux)
                image = self._spots_at(np.zeros((1, 2)), [0]).ravel()
                model = np.stack([image, np.ones(len(image))], axis=1)[:, :terms]
                scale = np.linalg.lstsq(model, shown)[0]
                fits.append((float(np.square(shown - model @ scale).sum()), factor, float(scale[0])))
            widths.append(min(fits)[1:])
        factor, flux = min(widths)
        self._is_hidden = factor * math.sqrt(seen.fwhm_x_px * seen.fwhm_y_px) > _WIDEST * self._pitch_px
        if self._is_hidden:
            return seen
        return SeenSpots(factor * seen.fwhm_x_px, factor * seen.fwhm_y_px, max(flux, 1.0) * seen.flux)

    @property
    def psf(self) -> dict[str, Any]:
        """Table [psf] of round Gaussian spots, without the blur of the pixels."""
        std = math.sqrt(max((self.fwhm_px * FWHM_TO_STD) ** 2 - 1 / 12, _SHARPEST_PX**2))
        return {"profile": "gaussian", "size": _rounded(0.5 * std / FWHM_TO_STD), "radius_px": 8.0}

    def _spots_at(self, positions: Floats, inwards: ArrayLike) -> Floats:
        """Return images (n, ny, nx) of Gaussian spots and their neighbours, without noise.

        They are integrated over the pixels. Spots have the neighbours in the direction `inwards` into the
        pupil (n,), a complex number; if it is 0, all.
        """
        images = self._single_spots(positions)
        inwards = np.asarray(inwards)
        for vector in self._around:
            lit = (inwards == 0) | ((np.conj(inwards) * vector).real > 0)
            beside = self._single_spots(positions + np.array([vector.real, vector.imag]))
            images += lit[:, None, None] * beside
        return images

    def _single_spots(self, positions: Floats) -> Floats:
        axes = []
        for axis, width in enumerate((self.spots.fwhm_x_px, self.spots.fwhm_y_px)):
            side = self._window[1 - axis]
            edges = np.arange(side + 1) - 0.5 * side - positions[:, axis, None]
            std = math.sqrt(max((width * FWHM_TO_STD) ** 2 - 1 / 12, _SHARPEST_PX**2))
            axes.append(np.diff(scipy.special.ndtr(edges / std)))
        return np.asarray(self.spots.flux * axes[0][:, None, :] * axes[1][:, :, None])

    def best(self) -> tuple[Settings, float]:
        """Return the settings of the smallest error, and the slope that they show for 1 px."""
        width = {
            "spot_fwhm_px": _rounded(self.spots.fwhm_x_px),
            "spot_fwhm_y_px": _rounded(self.spots.fwhm_y_px),
        }
        tight = _reach(_TIGHT * self._displacement)
        following = [
            Settings(
                "weighted", weight_fwhm_px=_rounded(factor * self.fwhm_px), search_range_px=reach, **width
            )
            for reach in (None, tight)
            for factor in self._weights
        ]
        systematic = [self.systematic(each)[0] for each in following]
        errors = [self._error(self._measured(each)) for each in following]
        if self._is_sharp:
            fits: list[tuple[float, Settings]] = []
            for name, steps in (("ml", 3), ("ml", _MORE_STEPS), ("map", _MORE_STEPS)):
                if min(systematic + [error for error, _ in fits]) > _BEFORE_FITS_PX:
                    fit = Settings(name, steps=steps, search_range_px=tight)
                    fits.append((self.systematic(fit)[0], fit))
            if fits and (best_fit := min(fits, key=lambda each: each[0]))[0] < min(systematic):
                return best_fit[1], 1.0
        windows = [
            self._reduced(
                Settings(
                    "window",
                    window_fwhm_px=_rounded(factor * self.fwhm_px),
                    search_range_px=tight,
                    flux_e=_rounded(self.spots.flux),
                    **width,
                )
            )
            for factor in _WINDOWS
        ]
        is_known = windows[0][1] > _LEAST_RESPONSE
        window, response = max(windows, key=lambda each: each[1]) if is_known else windows[0]
        most = max(_SYSTEMATIC_PX, min(systematic), _OF_ERROR * min(errors))
        best, least = following[0], math.inf
        for settings, error, by in zip(following, errors, systematic, strict=True):
            if by <= most and error < _BETTER * least:
                best, least = settings, error
        as_good = _MUCH_BETTER if self._is_sharp else _AS_GOOD
        if response < _FAINT and self._error(self._measured(window)) < as_good * least:
            return window, response
        return best, 1.0

    def _reduced(self, window: Settings) -> tuple[Settings, float]:
        """Return a fixed window with slopes of least squares, and the slope that they show for 1 px."""
        shown = self._measured(window.replace(centroid_gain=1.0))
        product = max(float((shown * self._truth).sum()), 1e-30)
        response = product**2 / float((shown**2).sum() * (self._truth**2).sum())
        gain = min(float((shown**2).sum()) / product, _LARGEST_GAIN)
        return window.replace(centroid_gain=_rounded(gain)), response

    def systematic(self, settings: Settings) -> tuple[float, float]:
        """Return the largest systematic error, and the constant one at the pupil's edge [px]."""
        errors = self._measured(settings, self._moved_images, self._references) - self._moved
        errors = errors.reshape(-1, _PHASES, 2)
        constant = errors.mean(axis=1)
        left = math.inf if self._is_hidden else np.abs(errors - constant[:, None]).max()
        return float(left), float(np.ptp(constant, axis=0).max())

    def _error(self, positions: Floats) -> float:
        return float(np.abs(positions - self._truth).mean())

    def _measured(
        self, settings: Settings, images: Floats | None = None, references: Floats | float = 0.0
    ) -> Floats:
        """Return the positions (n, 2) of the simulated spots, or of those in other images."""
        images, (ny, nx) = self._images if images is None else images, self._window
        layout = Layout.stacked(len(images), (ny, nx))
        layout = replace(layout, centres=layout.centres + references)
        frame = images.reshape(len(images) * ny, nx).astype(np.float32)
        psf = PSF.analytic(**self.psf) if Need.PSF in settings.estimator.needs else None
        camera = Calibration(dark=0.0, read_noise_e=self._noise)
        slopes = SlopePipeline(layout, settings, camera, psf=psf)(frame)
        return np.stack([slopes.x, slopes.y], axis=-1).astype(np.float64)


def _reach(value: float) -> float:
    return _rounded(max(value, _LEAST_RANGE_PX))


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
