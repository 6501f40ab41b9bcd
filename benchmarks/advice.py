"""Does the loop's own figure of merit see what the science camera would?

Two arms take turns in the simulated loop, which knows the truth. What `faintspot realtime advise --apply`
would measure, the difference of the residual wavefronts' mean squares without the noise, is set beside the
true difference, over all that the mirror, its modes and the sensor leave. The plain rms of the slopes is
there for comparison: it rewards the arm that sees least.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.measuring import Row, Table
from faintspot.advice.centroid_gain import calibration_of_electrons, shifted_gain
from faintspot.advice.residual import residual_wavefront, wavefront_modes
from faintspot.advice.simulated import frames_of_record, seen_in_record
from faintspot.ao_loop import Arm, LoopConfiguration, load_loop, simulate_loop
from faintspot.ao_loop.calibration import flat_psf, reference_slopes
from faintspot.ao_loop.camera import camera_calibration
from faintspot.ao_loop.configuration import ARCSEC
from faintspot.ao_loop.control import prior_std_px
from faintspot.ao_loop.telescope_model import prepare
from faintspot.experiments.statistics import paired_mean
from faintspot.pipeline.settings import Settings
from faintspot.pipeline.slope_pipeline import SlopePipeline

REALISATIONS, FRAMES, TURN, IMAGES_EVERY = 4, 1600, 100, 20
PHOTONS = 100.0, 300.0


def _arms(photons: float, width_px: float) -> dict[str, Arm]:
    window = Settings("window", flux_e=photons, window_fwhm_px=2.8 * width_px, centroid_gain=0.3)
    predicted: dict[str, Any] = {"correct_gain": False, "predict_prior": True}
    probable = Settings("map", flux_e=photons, prior_std_px=0.6)
    return {
        "window, gain 0.4": Arm("-", window, 0.4, correct_gain=False),
        "window, gain 0.2": Arm("-", window, 0.2, correct_gain=False),
        "brightest, gain 0.4": Arm("-", Settings("brightest"), 0.4, correct_gain=False),
        "map, gain 0.4": Arm("-", probable, 0.4, **predicted),
        "narrow window, gain 0.4": Arm("-", Settings("window", flux_e=photons), 0.4, correct_gain=False),
    }


def merits(configuration: LoopConfiguration, pair: list[Arm], realisation: int) -> np.ndarray:
    """Return by how much the second arm has more: the loop's figure, the truth, both nm^2, slopes' px^2."""
    schedule = np.arange(FRAMES) // TURN % 2
    run = configuration.replace("run", frames=FRAMES, settle_frames=TURN)
    record = simulate_loop(run, pair, schedule, realisation=realisation)
    sensor = prepare(configuration).sensor
    sizes: dict[str, Any] = {
        "subaperture_m": configuration.subaperture_m,
        "pixel_scale_arcsec": configuration.pixel_scale_rad / ARCSEC,
    }
    modes, _ = wavefront_modes(replace(sensor.layout, **sizes))
    gains = []
    for number, arm in enumerate(pair):
        own = [k for k in range(TURN, FRAMES, IMAGES_EVERY) if schedule[k] == number]
        pipeline = SlopePipeline(
            sensor.layout,
            arm.settings,
            calibration_of_electrons(camera_calibration(configuration)),
            reference_slopes(configuration, sensor, arm),
            psf=flat_psf(configuration.spot_width_px, 1.0),
            threads=1,
        )
        prior = prior_std_px(arm, 2 * len(sensor.layout))
        found = shifted_gain(pipeline, frames_of_record(record, own), prior)
        assert found is not None
        gains.append(found.value)
    seen = seen_in_record(record, pair)
    left = residual_wavefront(seen, modes, gains)
    scored = np.isfinite(left)
    frames = np.arange(FRAMES)[record.scored][: len(seen)]
    values = left, record.residual_nm[frames] ** 2, np.square(record.slopes_px[frames]).mean(axis=1)
    first, second = (scored & (seen.arm == number) for number in (0, 1))
    return np.array([value[second].mean() - value[first].mean() for value in values])


def run() -> list[Table]:
    """Compare pairs of arms."""
    rows = []
    for photons in PHOTONS:
        configuration = load_loop("camera_3e").replace("camera", photons_per_subaperture=photons)
        arms = _arms(photons, configuration.scene.seen_fwhm_px)
        first, *others = arms
        for name in others:
            pair = [arms[first], arms[name]]
            found = np.array([merits(configuration, pair, 1500 + r) for r in range(REALISATIONS)])
            columns: dict[str, float] = {}
            for title, values in zip(("told", "true"), found.T[:2], strict=True):
                mean = paired_mean(values)
                columns |= {
                    f"{title}, 1000 nm^2": mean.value / 1e3,
                    f"{title}: error": mean.standard_error / 1e3,
                }
            columns["slopes, px^2"] = float(found[:, 2].mean())
            agrees = bool(np.sign(found[:, 0].mean()) == np.sign(found[:, 1].mean()))
            rows.append(Row(f"{photons:g} photons: {name}", columns, "of the same sign", agrees))
    note = (
        f"less the window's with gain 0.4; {REALISATIONS} realisations of {FRAMES} frames in turns of {TURN}"
    )
    return [Table("advice-merit", "Residual wavefront: what the loop tells, and the truth", rows, [note])]
