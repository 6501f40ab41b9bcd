"""faintspot: wavefront slopes from faint Shack-Hartmann spots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot import simulate as simulate
    from faintspot import study as study
    from faintspot.errors import InputError as InputError
    from faintspot.errors import MissingExtraError as MissingExtraError
    from faintspot.estimate.brightest import brightest_pixels as brightest_pixels
    from faintspot.estimate.centroid import centre_of_gravity as centre_of_gravity
    from faintspot.estimate.total_variation import Denoised as Denoised
    from faintspot.estimate.total_variation import tv_denoise as tv_denoise
    from faintspot.flags import SubapertureFlag as SubapertureFlag
    from faintspot.pipeline import SlopePipeline as SlopePipeline
    from faintspot.pipeline import Slopes as Slopes
    from faintspot.pipeline import Stages as Stages
    from faintspot.sensor.calibration import Calibration as Calibration
    from faintspot.sensor.layout import Layout as Layout
    from faintspot.sensor.settings import Settings as Settings

__version__ = "0.1.0"

# Where each public name lives. They are imported at first use: `import faintspot` itself stays fast.
_HOMES = {
    "Calibration": "faintspot.sensor.calibration",
    "Denoised": "faintspot.estimate.total_variation",
    "InputError": "faintspot.errors",
    "Layout": "faintspot.sensor.layout",
    "MissingExtraError": "faintspot.errors",
    "Settings": "faintspot.sensor.settings",
    "SlopePipeline": "faintspot.pipeline",
    "Slopes": "faintspot.pipeline",
    "Stages": "faintspot.pipeline",
    "SubapertureFlag": "faintspot.flags",
    "brightest_pixels": "faintspot.estimate.brightest",
    "centre_of_gravity": "faintspot.estimate.centroid",
    "simulate": "faintspot.simulate",
    "study": "faintspot.study",
    "tv_denoise": "faintspot.estimate.total_variation",
}

__all__ = [*sorted(_HOMES), "__version__"]


__getattr__ = lazy_attributes(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
