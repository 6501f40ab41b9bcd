"""faintspot: wavefront slopes from faint Shack-Hartmann spots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base import __version__ as __version__
from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot import adapters as adapters
    from faintspot import data as data
    from faintspot import engine as engine
    from faintspot import experiments as experiments
    from faintspot import io as io
    from faintspot import loop as loop
    from faintspot import slopes as slopes
    from faintspot import testing as testing
    from faintspot.base.errors import InputError as InputError
    from faintspot.base.errors import MissingExtraError as MissingExtraError
    from faintspot.base.flags import SubapertureFlag as SubapertureFlag
    from faintspot.experiments import tune as tune
    from faintspot.loop import control as control
    from faintspot.slopes.camera.calibration import Calibration as Calibration
    from faintspot.slopes.camera.photon_transfer import measure_detector as measure_detector
    from faintspot.slopes.estimators.centroid import brightest_pixels as brightest_pixels
    from faintspot.slopes.estimators.centroid import centre_of_gravity as centre_of_gravity
    from faintspot.slopes.estimators.noise import Denoised as Denoised
    from faintspot.slopes.estimators.noise import tv_denoise as tv_denoise
    from faintspot.slopes.pipeline.following import SpotFollower as SpotFollower
    from faintspot.slopes.pipeline.images import measure_images as measure_images
    from faintspot.slopes.pipeline.light import MeanFlux as MeanFlux
    from faintspot.slopes.pipeline.settings import Settings as Settings
    from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline as SlopePipeline
    from faintspot.slopes.pipeline.slopes import Slopes as Slopes
    from faintspot.slopes.pipeline.slopes import Stages as Stages
    from faintspot.slopes.sensor.layout import Layout as Layout
    from faintspot.slopes.spots.bounds import cramer_rao as cramer_rao
    from faintspot.slopes.spots.bounds import cramer_rao_covariance as cramer_rao_covariance
    from faintspot.slopes.spots.bounds import photon_efficiency as photon_efficiency
    from faintspot.slopes.spots.fixed_weights import FixedWeights as FixedWeights
    from faintspot.slopes.spots.laser import LaserGuideStar as LaserGuideStar
    from faintspot.slopes.spots.psf import PSF as PSF
    from faintspot.slopes.spots.sodium import SodiumProfile as SodiumProfile
    from faintspot.slopes.training import learn_psf as learn_psf
    from faintspot.slopes.wavefront import Wavefront as Wavefront
    from faintspot.slopes.wavefront import fit_wavefront as fit_wavefront

# Imported at first use: `import faintspot` itself stays fast.
__getattr__, __dir__, __all__ = lazy_names(__name__)
__all__ += ["__version__"]
