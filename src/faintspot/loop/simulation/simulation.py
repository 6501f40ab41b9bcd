"""Simulation of the closed loop, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.loop.control.base import INTEGRATOR, CommandDelayLine
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import TRUE, Method
from faintspot.loop.simulation.record import LoopRecord, make_controller
from faintspot.loop.simulation.telescope import (
    TelescopeModel,
    atmosphere_of,
    centroid_gain,
    make_detector,
    make_pipeline,
    mean_flux,
    prepare,
    typical_spots,
    without_flux,
)
from faintspot.slopes.pipeline.configuration import to_text
from faintspot.slopes.pipeline.light import MeanFlux
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes

if TYPE_CHECKING:
    from faintspot.loop.control.identification.model import Kalman


_MOST_METHODS = 127
_FLUX_FRAMES = 20
"""Frames after which pipelines follow the mean flux, which changes over a thousand."""


def simulate_loop(
    configuration: LoopConfiguration,
    methods: Sequence[Method],
    schedule: ArrayLike | None = None,
    *,
    seed: int | None = None,
    realisation: int = 0,
    first_frame: ArrayLike = 0,
    progress: Callable[[int, int], None] | None = None,
) -> LoopRecord:
    """Run the loop once.

    In every frame the sensor sees, for the whole exposure, the wavefront of its middle after the mirror; the
    command computed from frame k acts first during the exposure of frame k + delay_frames. Air and noise
    depend on seed, realisation and frame alone: runs with other methods see the same.

    Parameters
    ----------
    configuration : LoopConfiguration
    methods : sequence of Method
    schedule : (frames,) array of int, optional
        Which method measures each frame. Default: the configuration's number of frames with the first method.
    seed : int, optional
        Default: the configuration's.
    realisation : int
        Other realisations have other air and other noise.
    first_frame : int, or (frames,) array of int
        Number of the first frame: a run that begins where another ended sees the turbulence go on. Or the
        numbers of all frames, increasing: frames that are left out cost no time.
    progress : callable, optional
        Called with the number of frames done and that of all, after every frame.

    Returns
    -------
    LoopRecord

    Raises
    ------
    InputError
        For a schedule that names methods that are not there, no methods, or parts that do not fit together.
    MissingExtraError
        When HCIPy is not installed.

    Examples
    --------
    >>> import faintspot as fs
    >>> from faintspot.loop.simulation import Method, LoopConfiguration, simulate_loop
    >>> loop = LoopConfiguration().replace("run", frames=40, settle_frames=20)
    >>> record = simulate_loop(loop, [Method("brightest", fs.Settings("brightest"))])
    >>> record.strehl.shape, record.slopes_px.shape, bool(record.strehl[-1] > record.strehl[0])
    ((40,), (40, 72), True)
    """
    numbers = _checked_schedule(configuration, methods, schedule)
    start = configuration.run.seed if seed is None else int(number_between("seed", seed, 0, integer=True))
    number = int(number_between("realisation", realisation, 0, integer=True))
    first = numbers_between("first_frame", first_frame, 0, integer=True).astype(np.int64)
    if first.ndim and (first.shape != numbers.shape or np.any(np.diff(first) < 1)):
        raise InputError(f"first_frame: expected a number, or {len(numbers)} increasing ones")
    of_frames = first if first.ndim else first + np.arange(len(numbers))
    ready = [_with_control(configuration, method, start) for method in methods]
    return _Loop(configuration, ready, numbers, start, number, of_frames).run(progress).record()


def measure_gains(
    configuration: LoopConfiguration, pipelines: Sequence[SlopePipeline], *, seed: int, realisation: int = 0
) -> NDArray[np.float64]:
    """Return the centroid gain of each pipeline at the configuration's flux, by `centroid_gain`."""
    optics, detector = prepare(configuration), make_detector(configuration)
    spots = _typical_spots(without_flux(configuration), seed, realisation)
    return np.array(
        [
            centroid_gain(pipeline, optics.sensor, detector, configuration.photons, spots, seed)
            for pipeline in pipelines
        ]
    )


class _Loop:
    """State and recorded values of one run."""

    def __init__(
        self,
        configuration: LoopConfiguration,
        ready: Sequence[tuple[Method, Kalman | None]],
        schedule: NDArray[np.int64],
        seed: int,
        realisation: int,
        frame_numbers: NDArray[np.int64],
    ) -> None:
        self.configuration = configuration
        self.methods = methods = [method for method, _ in ready]
        self.learnt = [learnt for _, learnt in ready]
        self.schedule, self.seed, self.realisation = schedule, seed, realisation
        self.frame_numbers = frame_numbers.tolist()
        self.telescope_model = TelescopeModel(configuration, seed, realisation)
        self.optics = optics = self.telescope_model.optics
        self.pipelines = [make_pipeline(configuration, optics.sensor, method) for method in methods]
        self.fluxes = [self._first_flux(pipeline) for pipeline in self.pipelines]
        for number in range(len(methods)):
            self._follow_flux(number)
        self.gains, self.divisors = self._gains_and_divisors()
        self.line = CommandDelayLine(optics.mirror.commands, configuration.control.delay_frames)
        self.controllers = [make_controller(configuration, optics, *pair, self.line) for pair in ready]
        frames, n = len(schedule), len(optics.sensor.layout)
        self.rows: dict[str, Any] = {
            "slopes_px": np.zeros((frames, 2 * n), np.float32),
            "valid": np.zeros((frames, n), np.bool_),
            "standard_error_px": np.zeros((frames, 2 * n), np.float32),
            "covariance_xy_px2": np.zeros((frames, n), np.float32),
            "commands": np.zeros((frames, optics.mirror.commands), np.float32),
            **{name: np.zeros(frames) for name in ("strehl", "residual_nm", "r0_m")},
        }
        """Values of each frame, by their names in `LoopRecord`."""

    def _first_flux(self, pipeline: SlopePipeline) -> MeanFlux | None:
        """Return the mean flux of every sub-aperture for an estimator that uses it, as before a run."""
        if not pipeline.settings.estimator.uses_flux or pipeline.settings.flux_e is not None:
            return None
        spots = _typical_spots(without_flux(self.configuration), self.seed, self.realisation)
        photons, sensor = self.configuration.photons, self.optics.sensor
        return mean_flux(pipeline, sensor, self.telescope_model.detector, photons, spots, self.seed)

    def _follow_flux(self, number: int) -> None:
        """Set the mean flux in a method's pipeline."""
        flux = self.fluxes[number]
        if flux is not None:
            self.pipelines[number] = self.pipelines[number].with_flux(flux)

    def _gains_and_divisors(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return each method's centroid gain and the divisor of its slopes."""
        gains = measure_gains(
            self.configuration, self.pipelines, seed=self.seed, realisation=self.realisation
        )
        gains = np.where([TRUE in method.variants for method in self.methods], 1.0, gains)
        divisors = np.where([method.corrects_gain for method in self.methods], gains, 1.0)
        for number, learnt in enumerate(self.learnt):
            if learnt is not None:  # from its telemetry, as at a telescope
                divisors[number] = learnt.centroid_gain
        return gains, divisors

    def run(self, progress: Callable[[int, int], None] | None) -> _Loop:
        """Simulate all frames."""
        frames = len(self.schedule)
        for frame in range(frames):
            self.step(frame)
            if progress is not None:
                progress(frame + 1, frames)
        return self

    def step(self, frame: int) -> None:
        """Simulate one frame."""
        number, commands = int(self.schedule[frame]), self.line.acting
        time = (self.frame_numbers[frame] + 0.5) / self.configuration.control.frame_rate_hz
        after, wavefront = self.telescope_model.wavefronts(time, commands)
        self._observe(frame, time, after)
        slopes = self._measure(frame, wavefront)
        error = np.concatenate([slopes.standard_error_x, slopes.standard_error_y])
        per_px = 1 / self.divisors[number]
        vector, covariance = (values.astype(np.float64) for values in (slopes.vector, slopes.covariance_xy))
        vector *= per_px
        self.controllers[number].update(vector, error.astype(np.float64) * per_px, covariance * per_px**2)
        self._note(
            frame,
            slopes_px=slopes.vector,
            valid=slopes.valid,
            standard_error_px=error,
            covariance_xy_px2=slopes.covariance_xy,
            commands=commands,
        )

    def _observe(self, frame: int, time: float, wavefront: NDArray[np.float32]) -> None:
        """Record the true values."""
        truth = self.telescope_model.truth(time, wavefront)
        self._note(frame, strehl=truth.strehl, residual_nm=truth.rms_nm, r0_m=truth.r0_m)

    def _note(self, frame: int, **values: ArrayLike) -> None:
        for name, value in values.items():
            self.rows[name][frame] = value

    def _measure(self, frame: int, wavefront: NDArray[np.float32]) -> Slopes:
        """Measure the slopes of the camera's frame."""
        number, sensor = int(self.schedule[frame]), self.optics.sensor
        if TRUE in self.methods[number].variants:
            return _true_slopes(sensor.mean_slopes_px(wavefront))
        prior = None
        if self.methods[number].is_predicted:
            prior = self.controllers[number].expected().mean_px
        pixels = self.telescope_model.frame(self.frame_numbers[frame], wavefront)
        slopes = self.pipelines[number](pixels, prior)
        flux = self.fluxes[number]
        if flux is not None:
            self.fluxes[number] = flux.updated(slopes.flux)
            if frame % _FLUX_FRAMES == 0:
                self._follow_flux(number)
        return slopes

    def record(self) -> LoopRecord:
        """Return the record of the run."""
        sensor = self.optics.sensor
        return LoopRecord(
            **self.rows,
            method=self.schedule.astype(np.int8),
            interaction_matrix=self.optics.interaction,
            centroid_gain=self.gains,
            corrected=np.array([method.corrects_gain for method in self.methods]),
            labels=tuple(method.label for method in self.methods),
            method_settings=tuple(to_text(method.settings) for method in self.methods),
            cells=sensor.layout.cells,
            illumination=sensor.illumination,
            configuration=self.configuration.to_text(),
            seed=self.seed,
            realisation=self.realisation,
        )


def _true_slopes(vector: NDArray[np.float64]) -> Slopes:
    """Return slopes without an error."""
    x, y = vector.astype(np.float32).reshape(2, -1)
    zeros, counts = np.zeros(len(x), np.float32), np.zeros(len(x), np.int32)
    return Slopes(x, y, zeros, np.zeros(len(x), np.uint8), counts, counts, zeros, zeros, zeros)


def _checked_schedule(
    configuration: LoopConfiguration, methods: Sequence[Method], schedule: ArrayLike | None
) -> NDArray[np.int64]:
    if not 1 <= len(methods) <= _MOST_METHODS:
        raise InputError(f"methods: expected 1 to {_MOST_METHODS}, got {len(methods)}")
    if len(methods) > 1 and any(method.control != INTEGRATOR for method in methods):
        raise InputError("methods: expected one, or several with the integrator alone")
    if schedule is None:
        return np.zeros(configuration.run.frames, np.int64)
    indices = numbers_between("schedule", schedule, 0, len(methods) - 1, integer=True)
    if indices.ndim != 1:
        raise InputError(f"schedule: expected one method for each frame, got shape {indices.shape}")
    return indices.astype(np.int64)


@lru_cache(maxsize=2)
def _typical_spots(
    configuration: LoopConfiguration, seed: int, realisation: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    optics, atmosphere = prepare(configuration), atmosphere_of(configuration, seed, realisation)
    return typical_spots(configuration, optics.sensor, optics.mirror, atmosphere, optics.reconstructor.matrix)


def _with_control(
    configuration: LoopConfiguration, method: Method, seed: int
) -> tuple[Method, Kalman | None]:
    """Return a method and its learnt controller, None for the integrator."""
    if method.control == INTEGRATOR:
        return method, None
    from faintspot.loop.simulation.learning import learnt_control

    return learnt_control(configuration, method, seed, simulate_loop)
