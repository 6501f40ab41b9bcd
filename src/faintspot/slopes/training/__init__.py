"""Learning from spots: the PSF, the sodium profile, the centroid gain."""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_attributes

if TYPE_CHECKING:
    from faintspot.slopes.training.centroid_gain import CentroidGain as CentroidGain
    from faintspot.slopes.training.centroid_gain import measure_centroid_gain as measure_centroid_gain
    from faintspot.slopes.training.psf_learning import LearntPSF as LearntPSF
    from faintspot.slopes.training.psf_learning import learn_psf as learn_psf
    from faintspot.slopes.training.psf_learning import learn_psf_from_images as learn_psf_from_images
    from faintspot.slopes.training.sodium import MeanImages as MeanImages
    from faintspot.slopes.training.sodium import SodiumFit as SodiumFit
    from faintspot.slopes.training.sodium import fit_sodium_profile as fit_sodium_profile
    from faintspot.slopes.training.sodium import fit_spot as fit_spot

_HOMES = {
    "CentroidGain": "faintspot.slopes.training.centroid_gain",
    "LearntPSF": "faintspot.slopes.training.psf_learning",
    "MeanImages": "faintspot.slopes.training.sodium",
    "SodiumFit": "faintspot.slopes.training.sodium",
    "fit_sodium_profile": "faintspot.slopes.training.sodium",
    "fit_spot": "faintspot.slopes.training.sodium",
    "learn_psf": "faintspot.slopes.training.psf_learning",
    "learn_psf_from_images": "faintspot.slopes.training.psf_learning",
    "measure_centroid_gain": "faintspot.slopes.training.centroid_gain",
}

__all__ = sorted(_HOMES)

__getattr__ = lazy_attributes(__name__, _HOMES)
