"""Quantities of star, camera, spots and turbulence measured from telemetry."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.telemetry.centroid_gain import calibration_of_electrons
from faintspot.loop.telemetry.engine_telemetry import LoopTelemetry
from faintspot.loop.telemetry.recording import site_of
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence
from faintspot.loop.turbulence.strength import OUTER_SCALE_M, Strength, turbulence_strength
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.algorithms.noise import pixel_noise
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import side_m
from faintspot.slopes.training.psf_learning import learn_psf_from_images

Floats = NDArray[np.float64]

_STRETCHES = 5  # parts of the telemetry whose scatter gives an error
_FEWEST_IMAGES = 10
_WIND_LAG = 8  # frames; long enough for a visible change of the turbulence
_WINDS_M_PER_S = np.geomspace(1.0, 60.0, 9)
_BINS = 256  # in a spectrum
_NEIGHBOURS = 10  # bins on each side that estimate the turbulence
_FALSE_ALARM = 0.01  # false-alarm probability of a spectrum without vibrations
_FIRST_BIN = 10  # below it the turbulence spectrum is too steep


@dataclass(frozen=True)
class Measured:
    """A quantity measured from telemetry."""

    name: str
    unit: str
    value: float = math.nan
    """Measured value; NaN if unknown."""
    error: float = math.nan
    """Standard error; NaN if unknown."""
    remark: str = ""
    """Reason why it is unknown, or assumptions of the value."""
    is_positive: bool = False
    """Whether negative values are impossible."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval; with small errors, or where only positive values occur, that of the logarithm."""
        if not self.value > 0 or (self.error > 0.5 * self.value and not self.is_positive):
            return self.value - 1.96 * self.error, self.value + 1.96 * self.error
        factor = math.exp(1.96 * self.error / self.value)
        return self.value / factor, self.value * factor

    def as_values(self) -> dict[str, Any]:
        """Return plain values, for JSON; None if unknown."""
        low, high = self.interval
        numbers = {"value": self.value, "error": self.error, "low": low, "high": high}
        plain = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        return {"name": self.name, "unit": self.unit, **plain, "remark": self.remark}

    def in_words(self) -> str:
        """Format the quantity as a line of text."""
        remark = f" ({self.remark})" if self.remark else ""
        if not math.isfinite(self.value):
            return f"{self.name}: not known{remark}"
        error = f" +- {self.error:.2g}" if math.isfinite(self.error) else ""
        return f"{self.name}: {self.value:.3g}{error} {self.unit}".rstrip() + remark


def of_images(frames_e: NDArray[np.float32], layout: Layout, calibration: Calibration) -> list[Measured]:
    """Return flux, read noise and spot width from frames in electrons.

    Parameters
    ----------
    frames_e : (images, h, w) array
    layout : Layout
    calibration : Calibration
        Calibration of the camera; if its dark is uncertain, the background is taken from the windows' edges.
    """
    flux = "flux", "e- per sub-aperture and frame"
    noise, width = ("read noise", "e-"), ("width of the spots", "px, with the pixel and the mean speckles")
    if len(frames_e) < _FEWEST_IMAGES:
        why = f"{len(frames_e)} images in telemetry, expected {_FEWEST_IMAGES}: images-every"
        return [Measured(*quantity, remark=why) for quantity in (flux, noise, width)]
    images = layout.images(frames_e)
    pixels = images.shape[-2] * images.shape[-1]
    background = calibration.background_e * pixels
    remark = "pixels above the calibrated dark"
    if calibration.rough_dark:
        background = pixels * float(np.median(images[..., [0, -1], :]))
        remark = "pixels above the windows' edges: wings are missing"
    sums = images.sum(axis=(-2, -1)).mean(axis=-1) - background
    halves = [pixel_noise(half) for half in np.array_split(images, 2)]
    measured = [
        Measured(*flux, float(sums.mean()), float(sums.std(ddof=1) / math.sqrt(len(sums))), remark),
        Measured(*noise, float(np.mean(halves)), abs(halves[0] - halves[1]) / 2),
    ]
    plain = calibration_of_electrons(calibration)
    try:
        spots = images.reshape(-1, *images.shape[-2:])
        psf = learn_psf_from_images(spots, calibration=plain, rng=np.random.default_rng(1)).psf
    except InputError as error:
        return [*measured, Measured(*width, remark=str(error))]
    return [*measured, Measured(*width, float(psf.fwhm_px.mean()))]


def of_atmosphere(telemetry: LoopTelemetry, layout: Layout, gain: float = 1.0) -> list[Measured]:
    """Return r0, the wind and vibrations, from slopes without the mirror's contribution."""
    residual, atmosphere = telemetry.weighted(gain)
    r0, wind = ("r0 at 500 nm", "m"), ("wind", "m/s")
    side = side_m(layout.cells, layout.subaperture_m, layout.diameter_m)
    if side is None or layout.pixel_scale_arcsec is None:
        why = "the layout lacks subaperture_m or pixel_scale_arcsec"
        measured = [Measured(*r0, remark=why), Measured(*wind, remark=why)]
    else:
        site = site_of(layout)
        measured = [
            *outer_scale_and_r0(turbulence_strength(atmosphere, residual, telemetry.segment, site)),
            _wind(Measured(*wind), telemetry, atmosphere, site),
        ]
    return [*measured, *_vibrations(telemetry, atmosphere)]


def _stretches(telemetry: LoopTelemetry) -> list[NDArray[np.int64]]:
    return list(np.array_split(np.arange(len(telemetry)), _STRETCHES))


def _of_stretches(kind: Measured, value: float, parts: list[float], remark: str) -> Measured:
    """Return a value with an error from the scatter between parts of the telemetry."""
    values = [part for part in parts if math.isfinite(part)]
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    if not math.isfinite(value):
        return Measured(kind.name, kind.unit, remark="the slopes vary no more than their noise")
    return Measured(kind.name, kind.unit, value, error, remark)


def outer_scale_and_r0(strength: Strength, known_scale_m: float | None = None) -> list[Measured]:
    """Return the outer scale, where it is known with this value, and r0."""
    remark = f"{OUTER_SCALE_M:g} m within a factor of two was expected" if known_scale_m is None else "given"
    name, unit = "r0 at 500 nm", "m"
    if not math.isfinite(strength.r0_m):
        outer = Measured("outer scale", "m", remark="unknown without r0")
        return [outer, Measured(name, unit, remark="the slopes vary no more than their noise")]
    outer = Measured("outer scale", "m", strength.outer_scale_m, strength.outer_scale_error_m, remark, True)
    return [outer, Measured(name, unit, strength.r0_m, strength.r0_error_m, is_positive=True)]


def _wind(kind: Measured, telemetry: LoopTelemetry, atmosphere: Floats, site: SlopeTurbulence) -> Measured:
    """Return the wind speed of a layer that changes the slopes as fast as observed, from any direction."""
    far = _WIND_LAG
    if telemetry.rate_hz <= 0 or len(telemetry) < 10 * far:
        return Measured(kind.name, kind.unit, remark=f"{len(telemetry)} frames are too few")
    anywhere = replace(site, wind_m_per_s=np.array([[1.0, 0.0]])).from_anywhere()
    still = _without_tilt(anywhere.covariance_px2(0.0))
    metres = np.concatenate([[0.0], _WINDS_M_PER_S * far / telemetry.rate_hz])
    theory = np.array([_without_tilt(anywhere.covariance_px2(metre)) for metre in metres]) / still

    def speed(rows: NDArray[np.int64]) -> float:
        slopes, turn = _without_mean(atmosphere[rows] - atmosphere.mean(axis=0)), telemetry.segment[rows]

        def lagged(lag: int) -> float:
            same_run = turn[lag:] == turn[:-lag]
            products = (slopes[lag:] * slopes[:-lag])[same_run]
            return float(products.mean()) if len(products) else math.nan

        share = 3 * lagged(far) / max(4 * lagged(1) - lagged(2), 1e-12)
        falling = np.minimum.accumulate(theory)
        moved = np.interp(-share, -falling, metres) if falling[-1] <= share <= 1 else math.nan
        return float(moved * telemetry.rate_hz / far)

    mean_speed = speed(np.arange(len(telemetry)))
    remark = "of a single layer that would change the slopes as fast"
    wind = _of_stretches(kind, mean_speed, [speed(part) for part in _stretches(telemetry)], remark)
    if not math.isfinite(mean_speed):
        return Measured(kind.name, kind.unit, remark=f"beyond {_WINDS_M_PER_S[-1]:g} m/s, or hidden by noise")
    return wind


def _without_mean(slopes: Floats) -> Floats:
    axes = slopes.reshape(len(slopes), 2, -1)
    return np.asarray((axes - axes.mean(axis=2, keepdims=True)).reshape(slopes.shape))


def _without_tilt(covariance: Floats) -> float:
    """Return the sum of variances about each axis's mean over the sub-apertures."""
    n = len(covariance) // 2
    total = float(np.trace(covariance))
    for axis in (slice(0, n), slice(n, 2 * n)):
        total -= float(covariance[axis, axis].mean()) * n
    return total


def _vibrations(telemetry: LoopTelemetry, atmosphere: Floats) -> list[Measured]:
    """Return lines in the spectra of tip and tilt that exceed the turbulence at neighbouring frequencies."""
    from scipy.signal import welch
    from scipy.stats import chi2

    name, unit = "vibrations", "Hz"
    starts = np.flatnonzero(np.concatenate([[True], np.diff(telemetry.segment) != 0, [True]]))
    longest = int(np.argmax(np.diff(starts)))
    rows = slice(starts[longest], starts[longest + 1])
    length = rows.stop - rows.start
    if length < 4 * _BINS:
        return [Measured(name, unit, remark=f"{length} frames without a gap, expected {4 * _BINS}")]
    lines, hidden = [], 0.0
    for axis, letter in enumerate("xy"):
        mean = atmosphere[rows].reshape(length, 2, -1)[:, axis].mean(axis=1)
        frequency, power = welch(mean, telemetry.rate_hz, nperseg=2 * _BINS, detrend="linear")
        beside = np.array([_median_beside(power, index) for index in range(len(power))])
        freedom = 2 * length / (2 * _BINS)
        limit = chi2.isf(_FALSE_ALARM / len(power), freedom) / freedom
        hidden = max(hidden, float((limit * beside[_FIRST_BIN:]).max() * frequency[1]))
        for index in np.flatnonzero(power > limit * beside):
            if index < _FIRST_BIN or power[index] < power[max(index - 2, 0) : index + 3].max():
                continue
            peak = slice(max(index - 2, 0), index + 3)
            square = float((power[peak] - beside[peak]).sum() * frequency[1])
            remark = f"along {letter}, rms {math.sqrt(max(square, 0.0)):.2g} px"
            lines.append(
                Measured("vibration", unit, float(frequency[index]), float(frequency[1] / 2), remark)
            )
    return lines or [Measured(name, "px", 0.0, remark=f"none with an rms above {math.sqrt(hidden):.2g} px")]


def _median_beside(power: Floats, index: int) -> float:
    """Return the median of the bins beside a bin, except its direct neighbours."""
    low, high = power[max(index - _NEIGHBOURS, 0) : max(index - 2, 0)], power[index + 3 : index + _NEIGHBOURS]
    return float(np.median(np.concatenate([low, high])))
