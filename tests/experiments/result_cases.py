"""Results of closed-loop experiments, small or made up, for tests of what is made of them."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

import faintspot as fs
from faintspot.ao_loop import LoopConfiguration, Method, simulate_loop
from faintspot.ao_loop.configuration import Camera
from faintspot.experiments.loop_results import BudgetResult, InterleavedResult, MagnitudeResult
from faintspot.pipeline.configuration import to_text

STRENGTHS = (np.nan, 0.0, 0.8)
BLOCK = 60
CYCLES = 3
NAMES = ("brightest", "tv", "ml", "ml_weighted")
LABELS = (
    "brightest pixels",
    "TV denoising",
    "maximum likelihood",
    "maximum likelihood, weighted reconstructor",
)
TERMS = ("nothing", "photon and read noise", "slope error")


@functools.cache
def small_interleaved() -> InterleavedResult:
    """Two short sets of a small telescope."""
    configuration = LoopConfiguration(camera=Camera(photons_per_subaperture=400.0, read_noise_e=0.5))
    configuration = configuration.replace("telescope", diameter_m=2.4).replace("sensor", subapertures=4)
    schedule = np.tile(np.repeat(np.arange(len(STRENGTHS)), BLOCK), CYCLES)
    configuration = configuration.replace("run", frames=len(schedule), settle_frames=20)
    methods = [
        Method("no TV", fs.Settings("brightest", keep_brightest=80))
        if np.isnan(strength)
        else Method(f"TV {strength:g}", fs.Settings(noise_std=strength, keep_brightest=80))
        for strength in STRENGTHS
    ]
    records = tuple(
        simulate_loop(configuration, methods, schedule, realisation=number) for number in range(2)
    )
    block = np.repeat(np.arange(CYCLES * len(STRENGTHS)), BLOCK)
    names = ("full gain, 2 strengths", "75 % gain, 2 strengths")
    return InterleavedResult(records, (block,) * 2, (np.array(STRENGTHS),) * 2, names, 20)


def made_up_interleaved(gain: float) -> InterleavedResult:
    """The same telemetry with Strehl ratios that drift, higher by `gain` with TV."""
    result = small_interleaved()
    frames = np.arange(result.records[0].frames)
    records = tuple(
        dataclasses.replace(record, strehl=0.3 + 1e-4 * frames + gain * (record.method == 2))
        for record in result.records
    )
    return dataclasses.replace(result, records=records)


def made_up_magnitude(gain_mag: float = 0.3, realisations: int = 6) -> MagnitudeResult:
    """Curves of one shape; TV is `gain_mag` fainter than brightest pixels, the likelihoods 1 mag."""
    rng = np.random.default_rng(3)
    magnitudes = np.linspace(13.0, 9.0, 5)
    atmosphere = rng.normal(0, 0.02, (5, realisations))
    shifts = (0.0, gain_mag, 1.0, 1.0)
    strehl = np.array(
        [
            0.6 / (1 + np.exp(1.5 * (magnitudes - 11 - shift)))[:, None]
            + atmosphere
            + rng.normal(0, 1e-3, atmosphere.shape)
            for shift in shifts
        ]
    )
    shape = (len(LABELS), 5)
    settings = np.full(shape, to_text(fs.Settings("brightest", keep_brightest=50)))
    axis = np.hypot(*np.meshgrid(np.arange(-32, 33), np.arange(-32, 33)))
    psf = np.broadcast_to(np.exp(-axis / 8), (*shape, 65, 65)).astype(np.float32)
    return MagnitudeResult(
        NAMES,
        LABELS,
        100 * 10 ** (-0.4 * (magnitudes - 10)),
        magnitudes,
        strehl,
        np.full(strehl.shape, 0.8),
        settings,
        np.full(shape, '{"loop_gain": 0.5}'),
        psf,
        LoopConfiguration().to_text(),
    )


def made_up_budget() -> BudgetResult:
    """Two methods, three terms, five realisations."""
    strehl = np.array([0.4, 0.5, 0.6])[None, :, None] + np.random.default_rng(1).normal(0, 0.01, (2, 3, 5))
    return BudgetResult(NAMES[:2], TERMS, LABELS[:2], strehl, 100 / strehl)
