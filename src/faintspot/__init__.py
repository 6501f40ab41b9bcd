"""faintspot: wavefront slopes from faint Shack-Hartmann spots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes
from faintspot.base.version import __version__ as __version__

if TYPE_CHECKING:
    from faintspot import adapters as adapters
    from faintspot import ao_loop as ao_loop
    from faintspot import control as control
    from faintspot import data as data
    from faintspot import estimators as estimators
    from faintspot import experiments as experiments
    from faintspot import export as export
    from faintspot import io as io
    from faintspot import realtime as realtime
    from faintspot import simulate as simulate
    from faintspot import testing as testing
    from faintspot import training as training
    from faintspot import wavefront as wavefront
    from faintspot.algorithms.brightest import brightest_pixels as brightest_pixels
    from faintspot.algorithms.centroid import centre_of_gravity as centre_of_gravity
    from faintspot.algorithms.total_variation import Denoised as Denoised
    from faintspot.algorithms.total_variation import tv_denoise as tv_denoise
    from faintspot.base.errors import InputError as InputError
    from faintspot.base.errors import MissingExtraError as MissingExtraError
    from faintspot.base.flags import SubapertureFlag as SubapertureFlag
    from faintspot.camera.calibration import Calibration as Calibration
    from faintspot.camera.photon_transfer import measure_detector as measure_detector
    from faintspot.experiments import tune as tune
    from faintspot.pipeline.images import measure_images as measure_images
    from faintspot.pipeline.mean_flux import MeanFlux as MeanFlux
    from faintspot.pipeline.settings import Settings as Settings
    from faintspot.pipeline.slope_pipeline import SlopePipeline as SlopePipeline
    from faintspot.pipeline.slopes import Slopes as Slopes
    from faintspot.pipeline.slopes import Stages as Stages
    from faintspot.sensor.layout import Layout as Layout
    from faintspot.spots.bounds import cramer_rao as cramer_rao
    from faintspot.spots.bounds import cramer_rao_covariance as cramer_rao_covariance
    from faintspot.spots.bounds import photon_efficiency as photon_efficiency
    from faintspot.spots.fixed_weights import FixedWeights as FixedWeights
    from faintspot.spots.laser import LaserGuideStar as LaserGuideStar
    from faintspot.spots.psf import PSF as PSF
    from faintspot.spots.score import TrainedScore as TrainedScore
    from faintspot.spots.sodium import SodiumProfile as SodiumProfile
    from faintspot.training import learn_psf as learn_psf
    from faintspot.training import train_estimator as train_estimator
    from faintspot.wavefront import Wavefront as Wavefront
    from faintspot.wavefront import fit_wavefront as fit_wavefront

_PACKAGES = (
    "adapters",
    "ao_loop",
    "control",
    "data",
    "estimators",
    "experiments",
    "export",
    "io",
    "realtime",
    "simulate",
    "testing",
    "training",
    "wavefront",
)
# Where each public name lives. They are imported at first use: `import faintspot` itself stays fast.
_HOMES = {
    "Calibration": "faintspot.camera.calibration",
    "Denoised": "faintspot.algorithms.total_variation",
    "FixedWeights": "faintspot.spots.fixed_weights",
    "InputError": "faintspot.base.errors",
    "LaserGuideStar": "faintspot.spots.laser",
    "Layout": "faintspot.sensor.layout",
    "MeanFlux": "faintspot.pipeline.mean_flux",
    "MissingExtraError": "faintspot.base.errors",
    "PSF": "faintspot.spots.psf",
    "Settings": "faintspot.pipeline.settings",
    "SlopePipeline": "faintspot.pipeline.slope_pipeline",
    "Slopes": "faintspot.pipeline.slopes",
    "SodiumProfile": "faintspot.spots.sodium",
    "Stages": "faintspot.pipeline.slopes",
    "SubapertureFlag": "faintspot.base.flags",
    "TrainedScore": "faintspot.spots.score",
    "Wavefront": "faintspot.wavefront",
    "brightest_pixels": "faintspot.algorithms.brightest",
    "centre_of_gravity": "faintspot.algorithms.centroid",
    "cramer_rao": "faintspot.spots.bounds",
    "cramer_rao_covariance": "faintspot.spots.bounds",
    "fit_wavefront": "faintspot.wavefront",
    "learn_psf": "faintspot.training",
    "measure_images": "faintspot.pipeline.images",
    "measure_detector": "faintspot.camera.photon_transfer",
    "photon_efficiency": "faintspot.spots.bounds",
    "train_estimator": "faintspot.training",
    "tune": "faintspot.experiments",
    "tv_denoise": "faintspot.algorithms.total_variation",
    **{name: f"faintspot.{name}" for name in _PACKAGES},
}

__all__ = [*sorted(_HOMES), "__version__"]


__getattr__ = lazy_attributes(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
