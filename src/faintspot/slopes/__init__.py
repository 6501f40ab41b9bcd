"""Frame -> slopes. Read in this order; each imports from those before it.

`kernels` (what is compiled), `sensor` (where the sub-apertures are), `camera` (calibration, detector),
`spots` (models of a spot), `simulate` (images with a known truth), `estimators` (how a position is found),
`pipeline` (`SlopePipeline`: calibration, estimator, slopes), `training` (learning from spots),
`wavefront` (Zernike modes), `recorded` (files of frames, and their report).
"""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.slopes import camera as camera
    from faintspot.slopes import estimators as estimators
    from faintspot.slopes import kernels as kernels
    from faintspot.slopes import pipeline as pipeline
    from faintspot.slopes import recorded as recorded
    from faintspot.slopes import sensor as sensor
    from faintspot.slopes import simulate as simulate
    from faintspot.slopes import spots as spots
    from faintspot.slopes import training as training
    from faintspot.slopes import wavefront as wavefront

__getattr__, __dir__, __all__ = lazy_names(__name__)
