"""Does the loop's own figure of merit see what the science camera would?

Two methods take turns in the simulated loop, which knows the truth. The difference of their residual
wavefronts' mean squares without the noise, as `faintspot realtime advise` measures them, is set beside the
true difference, over all that the mirror, its modes and the sensor leave. The plain rms of the slopes is
there for comparison: it rewards the method that sees least.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.telemetry import without_prior
from faintspot.loop.simulation import LoopConfiguration, LoopRecord, Method, load_loop, simulate_loop
from faintspot.loop.simulation.configuration.configuration import ARCSEC
from faintspot.loop.simulation.control import prior_std_px
from faintspot.loop.simulation.telescope.calibration import flat_psf, reference_slopes
from faintspot.loop.simulation.telescope.camera import camera_calibration
from faintspot.loop.simulation.telescope.model import TelescopeModel, prepare
from faintspot.loop.telemetry.centroid_gain import calibration_of_electrons, electrons_of, shifted_gain
from faintspot.loop.telemetry.engine_telemetry import LoopTelemetry
from faintspot.loop.telemetry.residual import residual_wavefront, wavefront_modes
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

REALISATIONS, FRAMES, TURN, IMAGES_EVERY = 4, 1600, 100, 20
PHOTONS = 100.0, 300.0


def _methods(photons: float, width_px: float) -> dict[str, Method]:
    window = Settings("window", flux_e=photons, window_fwhm_px=2.8 * width_px, centroid_gain=0.3)
    predicted: dict[str, Any] = {"correct_gain": False, "predict_prior": True}
    probable = Settings("map", flux_e=photons, prior_std_px=0.6)
    return {
        "window, gain 0.4": Method("-", window, 0.4, correct_gain=False),
        "window, gain 0.2": Method("-", window, 0.2, correct_gain=False),
        "brightest, gain 0.4": Method("-", Settings("brightest"), 0.4, correct_gain=False),
        "map, gain 0.4": Method("-", probable, 0.4, **predicted),
        "narrow window, gain 0.4": Method("-", Settings("window", flux_e=photons), 0.4, correct_gain=False),
    }


def seen_in_record(
    record: LoopRecord, methods: list[Method], number: int
) -> tuple[LoopTelemetry, np.ndarray]:
    """Return what the slopes of a method's scored frames show, and the numbers of these frames."""
    held = record.commands.astype(np.float64) @ record.interaction_matrix.T
    later, method = record.delay_frames - 1, methods[number]
    expected = np.zeros_like(held)
    if method.predict_prior:
        expected[: len(held) - later] = held[: len(held) - later] - held[later:]
    rows = np.flatnonzero(
        record.scored & (record.method == number) & (np.arange(record.frames) < record.frames - later)
    )
    divisor = record.centroid_gain[number] if record.corrected[number] else 1.0
    slopes, error = (each[rows] / divisor for each in (record.slopes_px, record.standard_error_px))
    prior = prior_std_px(method, held.shape[1])
    alone, _, trust = without_prior(
        slopes.astype(np.float64), error.astype(np.float64), expected[rows], prior
    )
    segment = np.concatenate([[0], np.cumsum(np.diff(rows) != 1)])
    return LoopTelemetry(segment, alone, trust, held[rows], record.frame_rate_hz), rows


def frames_of_record(record: LoopRecord, numbers: list[int]) -> np.ndarray:
    """Return frames of a simulated loop in electrons, simulated again."""
    configuration = LoopConfiguration.from_text(record.configuration)
    telescope_model = TelescopeModel(configuration, record.seed, record.realisation)
    frames = []
    for number in numbers:
        time_s = (number + 0.5) / record.frame_rate_hz
        _, seen = telescope_model.wavefronts(time_s, record.commands[number].astype(np.float64))
        frames.append(telescope_model.frame(number, seen))
    return electrons_of(np.stack(frames), camera_calibration(configuration))


def merits(configuration: LoopConfiguration, pair: list[Method], realisation: int) -> np.ndarray:
    """Return the second method's excess: the loop's figure, the truth, both nm^2, and slopes' px^2."""
    schedule = np.arange(FRAMES) // TURN % 2
    run = configuration.replace("run", frames=FRAMES, settle_frames=TURN)
    record = simulate_loop(run, pair, schedule, realisation=realisation)
    sensor = prepare(configuration).sensor
    sizes: dict[str, Any] = {
        "subaperture_m": configuration.subaperture_m,
        "pixel_scale_arcsec": configuration.pixel_scale_rad / ARCSEC,
    }
    modes, _ = wavefront_modes(replace(sensor.layout, **sizes))
    means = []
    for number, method in enumerate(pair):
        own = [k for k in range(TURN, FRAMES, IMAGES_EVERY) if schedule[k] == number]
        pipeline = SlopePipeline(
            sensor.layout,
            method.settings,
            calibration_of_electrons(camera_calibration(configuration)),
            reference_slopes(configuration, sensor, method),
            psf=flat_psf(configuration.spot_width_px, 1.0),
            threads=1,
        )
        prior = prior_std_px(method, 2 * len(sensor.layout))
        found = shifted_gain(pipeline, frames_of_record(record, own), prior)
        assert found is not None
        seen, frames = seen_in_record(record, pair, number)
        left = residual_wavefront(seen, modes, found.value)
        scored = np.isfinite(left)
        values = left, record.residual_nm[frames] ** 2, np.square(record.slopes_px[frames]).mean(axis=1)
        means.append([value[scored].mean() for value in values])
    return np.subtract(means[1], means[0])


def run() -> list[Table]:
    """Compare pairs of methods."""
    rows = []
    for photons in PHOTONS:
        configuration = load_loop("camera_3e").replace("camera", photons_per_subaperture=photons)
        methods = _methods(photons, configuration.scene.seen_fwhm_px)
        first, *others = methods
        for name in others:
            pair = [methods[first], methods[name]]
            found = np.array([merits(configuration, pair, 1500 + r) for r in range(REALISATIONS)])
            columns: dict[str, float] = {}
            for title, values in zip(("measured", "true"), found.T[:2], strict=True):
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
