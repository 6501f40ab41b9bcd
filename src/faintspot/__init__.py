"""faintspot: wavefront slopes from faint Shack-Hartmann spots."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    """Import a public name from its home at first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'faintspot' has no attribute {name!r}")
    home = importlib.import_module(_HOMES[name])
    value = home if _HOMES[name] == f"faintspot.{name}" else getattr(home, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
