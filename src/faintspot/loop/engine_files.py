"""What a real-time engine needs to know of a simulated telescope, as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from faintspot import configuration as configuration_file
from faintspot.control import configuration as control_file
from faintspot.files import output_errors, write_atomically
from faintspot.loop.arms import LoopArm
from faintspot.loop.calibration import flat_psf, make_pipeline, reference_slopes
from faintspot.loop.camera import camera_calibration
from faintspot.loop.configuration import LoopConfiguration
from faintspot.loop.observatory import prepare
from faintspot.loop.simulation import measure_gains
from faintspot.settings import Settings
from faintspot.tables import read_tables

CONFIGURATION = "faintspot.toml"
INTERACTION = "interaction_matrix.npy"
REFERENCE = "reference_slopes.npy"
_SETTINGS = Settings("brightest", keep_brightest=20)


def write_engine_files(configuration: LoopConfiguration, folder: str | Path) -> Path:
    """Write layout, calibration and PSF, and what a controller needs, into a folder.

    faintspot.toml (what else is in it stays; without an estimator it gets the 20 brightest pixels);
    interaction_matrix.npy, (2 n, commands) float64, px for a command of 1 nm; reference_slopes.npy, (2 n,)
    float32, px, what that estimator measures of a flat wavefront. Slopes are all x, then all y. [control] has
    the loop's gain, leak and delay where it says nothing else, and the estimator's centroid gain.

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
    gain = measure_gains(
        configuration, [make_pipeline(configuration, optics.sensor, arm)], seed=configuration.run.seed
    )
    loop, before = configuration.control, read_tables(path).get(control_file.TABLE, {})
    usual = {"gain": loop.gain, "leak": loop.leak, "delay_frames": loop.delay_frames}
    known_now = {
        "interaction_matrix": INTERACTION,
        "reference_slopes": REFERENCE,
        "centroid_gain": float(gain[0]),
    }
    control_file.save_control(path, **{**usual, **before, **known_now})
    return path
