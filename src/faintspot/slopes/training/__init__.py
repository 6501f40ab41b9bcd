"""Learning from spots: the PSF, the sodium profile, the centroid gain."""

from faintspot.slopes.training.centroid_gain import CentroidGain, measure_centroid_gain
from faintspot.slopes.training.psf_learning import LearntPSF, learn_psf, learn_psf_from_images
from faintspot.slopes.training.sodium import MeanImages, SodiumFit, fit_sodium_profile, fit_spot

__all__ = [
    "CentroidGain",
    "LearntPSF",
    "MeanImages",
    "SodiumFit",
    "fit_sodium_profile",
    "fit_spot",
    "learn_psf",
    "learn_psf_from_images",
    "measure_centroid_gain",
]
