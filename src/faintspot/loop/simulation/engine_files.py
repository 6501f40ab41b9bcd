"""Files with which a real-time engine controls a simulated telescope."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import output_errors, write_atomically
from faintspot.loop.control.base import INTEGRATOR, KALMAN
from faintspot.loop.control.configuration import save_control
from faintspot.loop.control.options import TABLE
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.learning import learnt_control
from faintspot.loop.simulation.methods import PREDICTED, PRIOR, Method
from faintspot.loop.simulation.simulation import measure_gains, simulate_loop
from faintspot.loop.simulation.telescope import camera_calibration, make_pipeline, prepare, reference_slopes
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF, spot_psf

CONFIGURATION = "faintspot.toml"
INTERACTION = "interaction_matrix.npy"
REFERENCE = "reference_slopes.npy"
MODEL = "control_model.npz"
# Chosen in simulated loops with other realisations of the turbulence than those shown.
WINDOW_WIDTH = 2.8
"""Width of the fixed window in widths of the spots."""


def write_engine_files(
    configuration: LoopConfiguration, folder: str | Path, control: str = INTEGRATOR
) -> Path:
    """Write layout, calibration, PSF and the controller's files into a folder.

    faintspot.toml (what else is in it stays; without an estimator it gets a fixed window);
    interaction_matrix.npy, (2 n, commands) float64, px for a command of 1 nm; reference_slopes.npy, (2 n,)
    float32, px, what that estimator measures of a flat wavefront. Slopes are all x, then all y. [control] has
    the loop's gain, leak and delay where it says nothing else, and the estimator's centroid gain.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Made where there is none.
    control : str
        Kind of control, see `control.base.CONTROLS`. All but the integrator learn from
        telemetry of the simulated loop, in other turbulence, which takes up to a minute: control_model.npz.

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
    psf = spot_psf(configuration.spot_width_px / 2, configuration.sensor.spot_elongation)
    sizes: dict[str, Any] = {
        "subaperture_m": configuration.subaperture_m,
        "pixel_scale_arcsec": configuration.pixel_scale_rad / ARCSEC,
    }
    configuration_file.save(path, replace(optics.sensor.layout, **sizes))
    configuration_file.save(path, camera_calibration(configuration))
    configuration_file.save(path, psf)
    if not configuration_file.has(path, "settings"):
        configuration_file.save(path, fixed_window(configuration))
    stored = configuration_file.Configuration(path)
    method = _method(stored.settings, psf, stored.weights, control)
    reference = reference_slopes(configuration, optics.sensor, method)
    write_atomically(folder / INTERACTION, lambda stream: np.save(stream, optics.interaction))
    write_atomically(folder / REFERENCE, lambda stream: np.save(stream, reference))
    loop, before = configuration.control, stored.tables.get(TABLE, {})
    usual = {"gain": loop.gain, "leak": loop.leak, "delay_frames": loop.delay_frames}
    measured = {"interaction_matrix": INTERACTION, "reference_slopes": REFERENCE, "centroid_gain": 1.0}
    seed = configuration.run.seed
    _, learnt = learnt_control(configuration, method, seed, simulate_loop)
    if learnt is not None:
        replace(learnt, centroid_gain=1.0).save(folder / MODEL)
        measured |= {"controller": control, "model": MODEL, "centroid_gain": learnt.centroid_gain}
    elif method.corrects_gain:
        pipeline = make_pipeline(configuration, optics.sensor, method)
        measured["centroid_gain"] = float(measure_gains(configuration, [pipeline], seed=seed)[0])
    save_control(path, **{**usual, **before, **measured})
    return path


def fixed_window(configuration: LoopConfiguration, **options: object) -> Settings:
    """Return settings of a fixed window for the configuration's star, with other options of the estimator."""
    width = float(f"{WINDOW_WIDTH * configuration.scene.seen_fwhm_px:.3g}")
    return Settings("window", window_fwhm_px=width, flux_e=configuration.photons, **options)


def _method(settings: Settings, psf: PSF, weights: FixedWeights | None, control: str) -> Method:
    """Return the method of the simulated loop that equals the engine's."""
    with_prior = control == KALMAN and settings.estimator.takes_prior
    if with_prior and PRIOR in settings.declared() and getattr(settings, PRIOR) is None:
        anything: dict[str, Any] = {PRIOR: 1.0}  # it becomes what the filter is sure of
        settings = settings.replace(**anything)
    return Method(
        "-", settings, psf=psf, weights=weights, control=control, variants=(PREDICTED,) if with_prior else ()
    )
