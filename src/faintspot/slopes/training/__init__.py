"""Learning from spots: the PSF, the sodium profile, the centroid gain."""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

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

__getattr__, __dir__, __all__ = lazy_names(__name__)
