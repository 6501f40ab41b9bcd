"""What a real-time engine needs to know of a simulated telescope, as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from faintspot import configuration as configuration_file
from faintspot.files import output_errors, write_atomically
from faintspot.loop.arms import LoopArm
from faintspot.loop.calibration import flat_psf, reference_slopes
from faintspot.loop.camera import camera_calibration
from faintspot.loop.configuration import LoopConfiguration
from faintspot.loop.observatory import prepare
from faintspot.settings import Settings

CONFIGURATION = "faintspot.toml"
INTERACTION = "interaction_matrix.npy"
REFERENCE = "reference_slopes.npy"
_SETTINGS = Settings("brightest", keep_brightest=20)


def write_engine_files(configuration: LoopConfiguration, folder: str | Path) -> Path:
    """Write layout, calibration and PSF, interaction matrix and reference slopes into a folder.

    faintspot.toml (what else is in it stays; without an estimator it gets the 20 brightest pixels);
    interaction_matrix.npy, (2 n, commands) float64, px for a command of 1 nm; reference_slopes.npy, (2 n,)
    float32, px, what that estimator measures of a flat wavefront. Slopes are all x, then all y.

    Returns
    -------
    Path
        Of faintspot.toml.

    Raises
    ------
    InputError
        When a file cannot be written, or faintspot.toml exists and cannot be understood.
    MissingExtraError
        When HCIPy is not installed.
    """
    folder = Path(folder)
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    optics = prepare(configuration)
    path = folder / CONFIGURATION
    psf = flat_psf(configuration.spot_width_px, configuration.sensor.spot_elongation)
    configuration_file.save(path, optics.sensor.layout)
    configuration_file.save(path, camera_calibration(configuration))
    configuration_file.save(path, psf)
    if not configuration_file.has(path, "settings"):
        configuration_file.save(path, _SETTINGS)
    known = configuration_file.load_all(path)
    arm = LoopArm("-", known.settings, psf=psf, score=known.score)
    reference = reference_slopes(configuration, optics.sensor, arm)
    write_atomically(folder / INTERACTION, lambda stream: np.save(stream, optics.interaction))
    write_atomically(folder / REFERENCE, lambda stream: np.save(stream, reference))
    return path
