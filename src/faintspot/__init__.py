"""faintspot: wavefront slopes from faint Shack-Hartmann spots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot import estimators as estimators
    from faintspot import experiments as experiments
    from faintspot import simulate as simulate
    from faintspot.errors import InputError as InputError
    from faintspot.errors import MissingExtraError as MissingExtraError
    from faintspot.estimate.bounds import cramer_rao as cramer_rao
    from faintspot.estimate.bounds import photon_efficiency as photon_efficiency
    from faintspot.estimate.brightest import brightest_pixels as brightest_pixels
    from faintspot.estimate.centroid import centre_of_gravity as centre_of_gravity
    from faintspot.estimate.total_variation import Denoised as Denoised
    from faintspot.estimate.total_variation import tv_denoise as tv_denoise
    from faintspot.experiments import tune as tune
    from faintspot.estimators.images import measure_images as measure_images
    from faintspot.flags import SubapertureFlag as SubapertureFlag
    from faintspot.light import MeanLight as MeanLight
    from faintspot.pipeline import SlopePipeline as SlopePipeline
    from faintspot.sensor.calibration import Calibration as Calibration
    from faintspot.sensor.fixed_weights import FixedWeights as FixedWeights
    from faintspot.sensor.layout import Layout as Layout
    from faintspot.sensor.photon_transfer import measure_detector as measure_detector
    from faintspot.sensor.psf import PSF as PSF
    from faintspot.sensor.score import TrainedScore as TrainedScore
    from faintspot.settings import Settings as Settings
    from faintspot.slopes import Slopes as Slopes
    from faintspot.slopes import Stages as Stages
    from faintspot.training import RunningPSF as RunningPSF
    from faintspot.training import learn_psf as learn_psf
    from faintspot.training import train_estimator as train_estimator
    from faintspot.wavefront import Wavefront as Wavefront
    from faintspot.wavefront import fit_wavefront as fit_wavefront

__version__ = "0.1.0"

# Where each public name lives. They are imported at first use: `import faintspot` itself stays fast.
_HOMES = {
    "Calibration": "faintspot.sensor.calibration",
    "Denoised": "faintspot.estimate.total_variation",
    "FixedWeights": "faintspot.sensor.fixed_weights",
    "InputError": "faintspot.errors",
    "Layout": "faintspot.sensor.layout",
    "MeanLight": "faintspot.light",
    "MissingExtraError": "faintspot.errors",
    "PSF": "faintspot.sensor.psf",
    "RunningPSF": "faintspot.training",
    "Settings": "faintspot.settings",
    "SlopePipeline": "faintspot.pipeline",
    "Slopes": "faintspot.slopes",
    "Stages": "faintspot.slopes",
    "SubapertureFlag": "faintspot.flags",
    "TrainedScore": "faintspot.sensor.score",
    "Wavefront": "faintspot.wavefront",
    "brightest_pixels": "faintspot.estimate.brightest",
    "centre_of_gravity": "faintspot.estimate.centroid",
    "cramer_rao": "faintspot.estimate.bounds",
    "estimators": "faintspot.estimators",
    "experiments": "faintspot.experiments",
    "fit_wavefront": "faintspot.wavefront",
    "learn_psf": "faintspot.training",
    "measure_images": "faintspot.estimators.images",
    "measure_detector": "faintspot.sensor.photon_transfer",
    "photon_efficiency": "faintspot.estimate.bounds",
    "simulate": "faintspot.simulate",
    "train_estimator": "faintspot.training",
    "tune": "faintspot.experiments",
    "tv_denoise": "faintspot.estimate.total_variation",
}

__all__ = [*sorted(_HOMES), "__version__"]


__getattr__ = lazy_attributes(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
