"""Results of closed-loop experiments, small or made up, for tests of what is made of them."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import faintspot as fs
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.loop.simulation import LoopConfiguration
from faintspot.slopes.pipeline.configuration import to_text

NAMES = ("brightest", "tv", "ml", "ml+weighted")
LABELS = (
    "brightest pixels",
    "TV denoising",
    "maximum likelihood",
    "maximum likelihood, weighted reconstructor",
)


def made_up_magnitude(gain_mag: float = 0.3, realisations: int = 6) -> MagnitudeResult:
    """Curves of one shape; TV is `gain_mag` fainter than brightest pixels, the likelihoods 1 mag."""
    rng = np.random.default_rng(3)
    magnitudes = np.linspace(13.0, 9.0, 5)
    atmosphere = rng.normal(0, 0.02, (5, realisations))
    shifts = (0.0, gain_mag, 1.0, 1.0)
    strehl = np.array(
        [
            0.6 / (1 + np.exp(1.5 * (magnitudes - 11 - shift)))[:, None]
            + atmosphere
            + rng.normal(0, 1e-3, atmosphere.shape)
            for shift in shifts
        ]
    )
    settings = np.full((len(LABELS), 5), to_text(fs.Settings("brightest", keep_brightest=50)))
    configuration = LoopConfiguration().to_text()
    photons = 100 * 10 ** (-0.4 * (magnitudes - 10))
    return result_of(NAMES, photons, strehl, labels=LABELS, settings=settings, configuration=configuration)


def result_of(
    names: tuple[str, ...], photons: ArrayLike, strehl: NDArray[np.float64], **others: Any
) -> MagnitudeResult:
    """Strehl ratios (methods, fluxes, realisations); 100 photo-electrons are 10 magnitudes."""
    shape, flux = strehl.shape[:2], np.asarray(photons, np.float64)
    values = {
        "labels": names,
        "magnitudes": 10 - 2.5 * np.log10(flux / 100),
        "centroid_gain": np.full(strehl.shape, 0.8),
        "settings": np.full(shape, ""),
        "choices": np.full(shape, '{"loop_gain": 0.5}'),
        "configuration": "",
    }
    return MagnitudeResult(names=names, photons=flux, strehl=strehl, **{**values, **others})
