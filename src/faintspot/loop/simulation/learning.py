"""Controllers learnt from telemetry of the simulated loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.loop.control.base import INTEGRATOR, OpenLoopTelemetry
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.open_loop import freed_of_prior, measured_delay, open_loop_of
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import PRIOR, TRUE, Method
from faintspot.loop.simulation.record import LoopRecord, plant_of, slope_turbulence
from faintspot.loop.simulation.sections import CLOSED, ControlParameters, RunLength
from faintspot.loop.simulation.telescope import prepare
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.pipeline.configuration import to_text

Simulate = Callable[..., LoopRecord]

FIRST_TELEMETRY_REALISATION = 2000
"""Realisation of the turbulence from which controllers learn; never scored or tuned on."""

_TELEMETRY_PRIOR_PX = 0.6  # while telemetry is taken, as nothing is known yet
_SETTLE_FRAMES = 50


def learnt_control(
    configuration: LoopConfiguration, method: Method, seed: int, simulate: Simulate
) -> tuple[Method, Kalman | None]:
    """Return the learnt controller of a method (None for the integrator), and the adapted method.

    The prior of an estimator that has one becomes as wide as the control is sure.

    Parameters
    ----------
    configuration : LoopConfiguration
    method : Method
    seed : int
    simulate : function
        `simulate_loop`, which makes the telemetry.

    Raises
    ------
    InputError
        For control that learns, in open loop.
    """
    if method.control == INTEGRATOR:
        return method, None
    if configuration.control.mode != CLOSED:
        raise InputError(f"method.control = {method.control!r}: expected {INTEGRATOR!r} in open loop")
    learnt = _learnt(
        replace(configuration, name="-", run=RunLength()),
        _TelemetryMethod.of(method),
        method.noise_scale,
        seed,
        simulate,
    )
    if method.has_prior:
        std = np.sqrt(np.square(learnt.expected_std_px).reshape(2, -1).mean(axis=0))
        method = method.with_options({PRIOR: std})
    return method, learnt


@dataclass(frozen=True)
class _TelemetryMethod:
    """Method, equal to others that would leave the same telemetry."""

    method: Method = field(compare=False)
    same: tuple[Any, ...]

    @classmethod
    def of(cls, method: Method) -> _TelemetryMethod:
        plain = replace(method, label="telemetry", control=INTEGRATOR, noise_scale=1.0)
        if method.has_prior:
            plain = plain.with_options({PRIOR: _TELEMETRY_PRIOR_PX})
        values = {
            **vars(plain),
            "settings": to_text(plain.settings),
            "psf": id(method.psf),
            "weights": id(method.weights),
        }
        return cls(plain, tuple(values.items()))


@lru_cache(maxsize=4)  # a search scales the noise of one model by three factors
def _learnt(
    configuration: LoopConfiguration,
    method: _TelemetryMethod,
    noise_scale: float,
    seed: int,
    simulate: Simulate,
) -> Kalman:
    if noise_scale != 1.0:  # learning takes long
        return _learnt(configuration, method, 1.0, seed, simulate).with_noise(noise_scale)
    optics, control = prepare(configuration), configuration.control
    telemetry, gain = _telemetry(_without_assumed(configuration), method, seed, simulate)
    site = slope_turbulence(configuration, optics.sensor.layout.cells)
    known = site, control.frame_rate_hz, control.winds
    learnt = learn_controller(plant_of(configuration, optics), telemetry, *known)
    return replace(learnt, centroid_gain=gain)


@lru_cache(maxsize=1)  # for several controls; 170 MB with 40 x 40 sub-apertures
def _telemetry(
    configuration: LoopConfiguration, method: _TelemetryMethod, seed: int, simulate: Simulate
) -> tuple[OpenLoopTelemetry, float]:
    """Run the loop with an integrator in turbulence that is never scored; return also the centroid gain."""
    frames = configuration.control.telemetry_frames
    run = configuration.replace("run", frames=frames, settle_frames=0)
    record = simulate(run, [method.method], seed=seed, realisation=FIRST_TELEMETRY_REALISATION)
    loop = recorded_loop(record, method.method)
    delay = LoopDelay(record.loop.control.delay_frames, 0.0, 1.0, 0.0)
    if method.method.corrects_gain and TRUE not in method.method.variants:
        try:
            _, delay = measured_delay(loop)
        except InputError as error:
            raise InputError(
                f"control.telemetry_frames = {frames}: too few for the centroid gain ({error})"
            ) from None
    return open_loop_of(loop, delay).telemetry, delay.gain


def recorded_loop(record: LoopRecord, method: Method) -> Recording:
    """Return what a telescope records of a run of one method with the integrator, freed of its prior."""
    loop = record.loop
    delay = loop.control.delay_frames
    sent = record.commands[delay:]  # computed from each frame
    recording = Recording(
        record.slopes_px[: len(sent)],
        sent,
        record.interaction_matrix,
        record.cells,
        loop.control.frame_rate_hz,
        subaperture_m=loop.subaperture_m,
        pixel_scale_arcsec=loop.pixel_scale_rad / ARCSEC,
        delay_frames=delay,
        standard_errors=record.standard_error_px[: len(sent)],
        covariance_xy=record.covariance_xy_px2[: len(sent)],
        prior_std=method.prior_std_px(len(record.interaction_matrix)),
        slope_unit="px",
    )
    return freed_of_prior(recording, is_predicted=method.is_predicted).part(slice(_SETTLE_FRAMES, None))


def _without_assumed(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration without values that do not affect the telemetry."""
    return configuration.replace("control", winds=ControlParameters().winds)
