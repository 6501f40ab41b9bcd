"""Random spots for every estimator, and what holds of their slopes whatever they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.spots.psf import PSF

NEED_PSF = ("ml", "map")
FIELDS = (
    *("x", "y", "flux", "flags", "iterations", "bad_pixels"),
    *("standard_error_x", "standard_error_y", "covariance_xy"),
)


@dataclass
class Case:
    images: NDArray[Any]
    settings: fs.Settings
    calibration: fs.Calibration
    psf: PSF | None = None
    prior: NDArray[Any] | None = None

    @property
    def layout(self) -> fs.Layout:
        n, ny, nx = self.images.shape
        return fs.Layout((n * ny, nx), (ny, nx), np.column_stack([ny * np.arange(n), np.zeros(n, int)]))

    def pipeline(self, **options: Any) -> fs.SlopePipeline:
        parts = {"psf": self.psf, **options}
        return fs.SlopePipeline(self.layout, self.settings, self.calibration, **parts)

    def measure(self, **options: Any) -> fs.Slopes:
        return self.pipeline(**options)(self.images.reshape(-1, self.images.shape[2]), self.prior)

    def each(self, name: str) -> NDArray[Any]:
        n, ny, nx = self.images.shape
        return self.settings.values(name, n, ny * nx)

    def select(self, places: Any) -> Case:
        """The same for some of the images."""
        per_image = {
            name: value[places]
            for name, value in self.settings.chosen().items()
            if isinstance(value, np.ndarray)
        }
        psf = self.psf
        if psf is not None and psf.index is not None:
            psf = one_of_several(psf.index[places])
        prior = None if self.prior is None else self.prior[places]
        settings, calibration = self.settings.replace(**per_image), self.calibration
        if isinstance(calibration.read_noise_e, np.ndarray):
            noise = calibration.read_noise_e.reshape(self.images.shape)[places]
            calibration = replace(calibration, read_noise_e=noise.reshape(-1, noise.shape[2]))
        return Case(self.images[places], settings, calibration, psf, prior)


# Cases ------------------------------------------------------------------------------------------------


@cache
def several_psfs() -> PSF:
    """Round and elongated spots of two kinds, some of several separable terms; radius beyond any window."""
    kinds = [
        PSF.analytic(profile, size=size, elongation=elongation, angle_deg=angle, radius_px=26).samples[0]
        for profile, size, elongation, angle in (
            ("gaussian", 1.0, 1.0, 0.0),
            ("diffraction", 1.2, 1.0, 0.0),
            ("gaussian", 1.1, 1.7, 35.0),
        )
    ]
    return PSF(np.stack(kinds), 8, [0, 1, 2])


def one_of_several(index: NDArray[Any]) -> PSF:
    """One of those for each spot; decomposed once, which takes longer than most tests."""
    psf = PSF(several_psfs().samples, 8, index)
    psf.__dict__["separable_terms"] = several_psfs().separable_terms
    return psf


@cache
def one_psf() -> PSF:
    """One separable term."""
    return PSF.analytic("gaussian", size=0.9, radius_px=26)


def settings_of(estimator: str, **options: Any) -> fs.Settings:
    """Settings with those of the options that the estimator has."""
    return with_options(
        fs.Settings(estimator, **({"noise_std": 0.0} if estimator == "tv" else {})), **options
    )


def with_options(settings: fs.Settings, **options: Any) -> fs.Settings:
    """The same with those of the options changed that the estimator has."""
    declared = settings.declared()
    return settings.replace(**{name: value for name, value in options.items() if name in declared})


def random_settings(rng: np.random.Generator, estimator: str, n: int, window: tuple[int, int]) -> fs.Settings:
    """Different settings for every sub-aperture."""
    pixels = window[0] * window[1]
    optional: dict[str, Any] = {}
    if rng.random() < 0.5:
        optional["search_range_px"] = rng.uniform(1.0, max(window), n)
    return settings_of(
        estimator,
        noise_std=0.0,
        keep_brightest=rng.integers(3, pixels, n),
        threshold_e=rng.uniform(0.0, 20.0, n),
        smoothing_px=rng.uniform(0.3, 1.5, n),
        spot_fwhm_px=rng.choice([1.8, 2.5], n),
        spot_fwhm_y_px=rng.choice([1.8, 3.0], n),
        weight_fwhm_px=rng.uniform(2.0, 5.0, n),
        steps=int(rng.integers(1, 6)),
        model_error=rng.choice([0.0, 0.3], n),
        weight_floor=rng.choice([1e-3, 1e-2], n),
        flux_e=rng.uniform(20.0, 2000.0, n),
        prior_std_px=rng.uniform(0.2, 2.0, n),
        error_scale=rng.uniform(0.5, 2.0, n),
        **optional,
        **(window_options(rng, n) if estimator == "window" else {}),
    )


def window_options(rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Of fixed windows."""
    return {
        "window_fwhm_px": rng.uniform(2.0, 20.0, n),
        "region_px": rng.uniform(6.0, 40.0, n),
        "normalisation": str(rng.choice(["mean", "frame"])),
        "centroid_gain": None if rng.random() < 0.7 else rng.uniform(0.3, 1.5, n),
    }


def random_case(
    seed: int, estimator: str, n: int | None = None, window: tuple[int, int] | None = None
) -> Case:
    """Spots of 30 to 3,000 electrons about the windows' middle, the usual noises, a few bad pixels."""
    rng = np.random.default_rng(seed)
    ny, nx = window or (int(rng.integers(4, 21)), int(rng.integers(4, 25)))
    n = int(rng.integers(1, 13)) if n is None else n
    psf = one_psf()
    if rng.random() < 0.6:
        psf = one_of_several(rng.integers(0, 3, n))
    noise, background = float(rng.choice([0.1, 0.3, 1.0, 3.0])), float(rng.choice([0.0, 2.0]))
    detector = fs.slopes.simulate.Detector(
        noise,
        background_e=background,
        em_gain=float(rng.choice([1.0, 1.0, 50.0])),
        gain_e_per_adu=float(rng.choice([1.0, 1.7])),
    )
    places = rng.uniform(-0.3, 0.3, (n, 2)) * (nx, ny)
    flux = 10 ** rng.uniform(1.5, 3.5, n)
    mean = psf.images(places, (ny, nx), flux, which=psf.index_of(n))
    images = detector.expose(np.maximum(mean, 0.0), rng).astype(np.float32)
    if rng.random() < 0.3:
        images[rng.random(images.shape) < 0.01] = np.nan
    calibration = fs.Calibration(
        dark=background * detector.em_gain / detector.gain_e_per_adu,
        gain_e_per_adu=detector.gain_e_per_adu,
        em_gain=detector.em_gain,
        read_noise_e=noise,
        background_e=background,
        saturation_adu=3000.0 if rng.random() < 0.3 else None,
    )
    settings = random_settings(rng, estimator, n, (ny, nx))
    prior = places + rng.normal(0.0, 0.3, (n, 2)) if rng.random() < 0.5 else None
    return Case(images, settings, calibration, psf if estimator in NEED_PSF else None, prior)


def with_noise_map(case: Case, seed: int) -> Case:
    """The same with a read noise of each pixel: a tail, noiseless and very noisy pixels, a few bad ones."""
    rng = np.random.default_rng(seed)
    n, ny, nx = case.images.shape
    noise = case.calibration.read_noise_e * rng.lognormal(0.0, 0.7, (n * ny, nx))
    for share, value in ((0.02, 0.0), (0.01, 100.0), (0.01, np.nan)):
        noise[rng.random(noise.shape) < share] = value
    return replace(case, calibration=replace(case.calibration, read_noise_e=noise))


# Slopes ---------------------------------------------------------------------------------------------


def assert_sane(slopes: fs.Slopes) -> None:
    """What holds whatever the images are."""
    for name in ("x", "y", "flux"):
        assert np.all(np.isfinite(getattr(slopes, name))), name
    invalid = ~slopes.measured
    for name in ("x", "y"):
        error = getattr(slopes, f"standard_error_{name}")
        assert np.all(getattr(slopes, name)[invalid] == 0)
        assert np.all(np.isposinf(error[invalid]))
        assert np.all(error[slopes.measured] >= 0)  # and not NaN; 0 where a single pixel is left
    known = np.isfinite(slopes.standard_error_x)
    largest = slopes.standard_error_x[known].astype(float) * slopes.standard_error_y[known]
    assert np.all(np.abs(slopes.covariance_xy[known]) <= largest * (1 + 1e-6))  # rounding of float32
    assert np.all(slopes.covariance_xy[~known] == 0)


def assert_same(a: fs.Slopes, b: fs.Slopes, select: Any = slice(None)) -> None:
    """Bit by bit."""
    for name in FIELDS:
        left, right = getattr(a, name)[..., select], getattr(b, name)
        assert np.array_equal(left, right), name
