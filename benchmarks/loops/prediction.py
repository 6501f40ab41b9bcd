"""Prediction in closed loop: ours against pyRTC's, on the same slopes.

Slopes by a fixed window near the diffraction limit, with and without a vibration of the telescope. Winds and
vibration are learnt from the telemetry of an integrator. The rivals (`pip install pyrtcao`, GPL-3) learn from
the same telemetry; their options and gain are those that leave the least phase on other telemetry, as the
integrator's gain is. All are scored on other turbulence; the rivals with brighter stars as well, so that the
gain in magnitudes shows.
"""

import importlib.util
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.base import (
    LEARNT,
    CommandDelayLine,
    Controller,
    ExpectedSlopes,
    OpenLoopTelemetry,
)
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.identification.learning import GAINS, learn_controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.vibrations import Vibration
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop
from faintspot.loop.simulation.atmosphere import MovingLayers
from faintspot.loop.simulation.record import slope_turbulence
from faintspot.loop.simulation.simulation import measure_gains
from faintspot.loop.simulation.telescope import TelescopeModel, make_pipeline, prepare
from faintspot.loop.slope_covariance import SlopeTurbulence
from faintspot.slopes.pipeline.settings import Settings

Floats = NDArray[np.float64]
Make = Callable[[CommandDelayLine], Controller]

FLUXES = 20.0, 27.0, 36.0
"""Of the rivals; ours and the integrator have the first."""
REALISATIONS, FRAMES, SETTLE = 3, 900, 100
LEARNING, TUNING = (2000, 2000), (2001, 1000)
"""Realisation and number of frames."""
VIBRATION_NM, WIDTH_PX, TELEMETRY_GAIN = 120.0, 2.2, 0.2
OURS, TARGET = "learnt", 0.3
VIBRATION = Vibration("tip", 45.0, 0.005, 1.0, 0.0, 0.0)
_GRIDS: dict[str, dict[str, tuple[Any, ...]]] = {
    "least_squares": {"order": (4, 8, 16, 32), "regularization": (1e-3, 1e-2, 1e-1, 1.0)},
    "ar_kalman": {"noise_band": (0.05, 0.1, 0.2, 0.4)},
}
_GAINS = (0.3, 0.5, 0.7, 1.0)


class Shaken:
    """Turbulence and a vibration of the telescope in tip or tilt."""

    def __init__(
        self,
        layers: MovingLayers,
        vibration: Vibration,
        amplitude_nm: float,
        rate_hz: float,
        seed: Sequence[int],
        frames: int,
    ) -> None:
        self.layers, self._rate_hz = layers, rate_hz
        one, two = vibration.recursion(rate_hz)
        driving = np.sqrt(vibration.driving_variance(rate_hz))
        values = [0.0, 0.0]
        for noise in np.random.default_rng(seed).standard_normal(frames + 2000):
            values.append(one * values[-1] + two * values[-2] + driving * noise)
        self.values_nm = amplitude_nm * np.array(values[2000:], np.float32)
        """Rms over the square around the pupil in each frame, with its sign."""
        tip = np.broadcast_to(np.linspace(-1, 1, layers.points, dtype=np.float32), (layers.points,) * 2)
        shape = tip if vibration.mode == "tip" else tip.T
        self._shape: NDArray[np.float32] = shape / np.sqrt(np.mean(shape**2))

    def r0_m(self, time_s: float) -> float:
        """See `MovingLayers`."""
        return self.layers.r0_m(time_s)

    def wavefront_nm(self, time_s: float) -> NDArray[np.float32]:
        """See `MovingLayers`."""
        value = np.float32(self.values_nm[int(time_s * self._rate_hz)])
        return self.layers.wavefront_nm(time_s) + value * self._shape


class Rival(Controller):
    """A modal predictor of pyRTC as a controller: the command goes part of the way to the prediction."""

    undoes_prior = True

    def __init__(
        self, line: CommandDelayLine, plant: LoopPlant, to_modes: Floats, predictor: Any, gain: float
    ):
        super().__init__(line, plant.interaction)
        self._plant, self._to_modes, self._gain = plant, to_modes, gain
        self._predictor = predictor
        self.begin()

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        return ExpectedSlopes(self._plant.interaction @ self.line.acting, None)

    def begin(self) -> None:
        """See `Controller`."""
        self._predictor.reset()

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        line, modes = self.line, self._plant.reconstructor.modes
        open_loop = slopes_px - self._plant.interaction @ line.acting
        self._predictor.update(self._to_modes @ np.where(np.isfinite(standard_error_px), open_loop, 0.0))
        wanted = modes @ np.asarray(self._predictor.predict(), np.float64)
        line.put((1 - self._gain) * line.latest - self._gain * wanted)


@dataclass(frozen=True)
class Case:
    """A star, with or without the vibration, and a loop with a window of some width."""

    photons: float
    vibration_nm: float
    name: str = "diffraction_limit"
    width_px: float = WIDTH_PX

    @property
    def configuration(self) -> LoopConfiguration:
        """The loop."""
        return load_loop(self.name).replace("camera", photons_per_subaperture=self.photons)

    @property
    def plant(self) -> LoopPlant:
        """What a controller needs to know of the loop."""
        optics, control = prepare(self.configuration), self.configuration.control
        return LoopPlant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return self.configuration.control.frame_rate_hz

    @property
    def site(self) -> SlopeTurbulence:
        """Theory of the slopes, of which learning uses the geometry."""
        return slope_turbulence(self.configuration, prepare(self.configuration).sensor.layout.cells)

    def observed(self, make: Make, realisation: int, frames: int) -> tuple[float, OpenLoopTelemetry]:
        """Run the loop; return its mean Strehl ratio and its telemetry."""
        run = Run(self, realisation, frames)
        controller = make(run.line)
        for _ in range(frames):
            run.step(controller)
        return float(run.strehl[SETTLE:].mean()), run.telemetry(SETTLE, frames)

    def learnt(self, telemetry: OpenLoopTelemetry, winds: str = LEARNT) -> Kalman:
        """Return our filter."""
        return learn_controller(self.plant, telemetry, self.site, self.rate_hz, winds)

    def telemetry(self) -> tuple[OpenLoopTelemetry, OpenLoopTelemetry]:
        """Return telemetry with an integrator, to learn from and to tune with."""
        make = partial(self.plant.integrator, TELEMETRY_GAIN)
        return self.observed(make, *LEARNING)[1], self.observed(make, *TUNING)[1]

    @property
    def phase(self) -> Floats:
        """See `residual_phase`."""
        plant, cells = self.plant, prepare(self.configuration).sensor.layout.cells
        return residual_phase(plant.reconstructor.matrix, plant.interaction, cells)

    def integrator(self, tuning: OpenLoopTelemetry) -> Make:
        """Return the integrator with the gain that leaves the least phase variance."""
        return partial(self.plant.integrator, self.plant.best_gain(GAINS, tuning, self.phase)[0])

    def controllers(self, *, ours: bool) -> dict[str, Make]:
        """Return controllers that have learnt: the rivals, tuned, and the integrator and ours."""
        plant, phase, (learning, tuning) = self.plant, self.phase, self.telemetry()
        found: dict[str, Make] = {
            name: min(rivals(name, plant, learning), key=lambda make: plant.residual(make, tuning, phase))
            for name in _GRIDS
        }
        if ours:
            found |= {
                "integrator": self.integrator(tuning),
                OURS: partial(self.learnt(learning).guarded, self.plant),
            }
        return found


class Run:
    """A run of the loop, and what it has recorded.

    Parameters
    ----------
    case : Case
    realisation, frames : int

    Attributes
    ----------
    line : CommandDelayLine
        To the mirror.
    model : TelescopeModel
    frame : int
        Number of frames done.
    strehl : (frames,) array
    slopes, errors : (frames, 2 n) array
    """

    def __init__(self, case: Case, realisation: int, frames: int) -> None:
        configuration, self._plant, self._rate_hz = case.configuration, case.plant, case.rate_hz
        self.model = TelescopeModel(configuration, 1, realisation)
        sensor = self.model.optics.sensor
        if case.vibration_nm:
            known = VIBRATION, case.vibration_nm, self._rate_hz, [realisation, 45]
            shaken: Any = Shaken(self.model.atmosphere, *known, frames)
            self.model.atmosphere = shaken
        flux_e = case.photons * sensor.illumination
        settings = Settings("window", window_fwhm_px=case.width_px, flux_e=flux_e)
        self._pipeline = make_pipeline(configuration, sensor, Method("window", settings))
        self._centroid_gain = measure_gains(configuration, [self._pipeline], seed=1)[0]
        self.line = CommandDelayLine(self.model.optics.mirror.commands, self._plant.delay_frames)
        self.frame, self.strehl = 0, np.zeros(frames)
        self.slopes, self.errors, self._held = np.zeros((3, frames, len(self._plant.interaction)))

    @property
    def time_s(self) -> float:
        """Middle of the next frame."""
        return (self.frame + 0.5) / self._rate_hz

    def step(self, controller: Controller) -> None:
        """Simulate a frame."""
        frame, time_s, model, acting = self.frame, self.time_s, self.model, self.line.acting
        self._held[frame] = self._plant.interaction @ acting
        after, seen = model.wavefronts(time_s, acting)
        self.strehl[frame] = model.truth(time_s, after).strehl
        found = self._pipeline(model.frame(frame, seen))
        self.slopes[frame] = found.vector / self._centroid_gain
        self.errors[frame] = np.r_[found.standard_error_x, found.standard_error_y] / self._centroid_gain
        controller.update(self.slopes[frame], self.errors[frame])
        self.frame += 1

    def telemetry(self, first: int, last: int) -> OpenLoopTelemetry:
        """Return the telemetry of some frames."""
        slopes, errors, held = (each[first:last] for each in (self.slopes, self.errors, self._held))
        return OpenLoopTelemetry(slopes - held, np.square(errors), np.isfinite(errors).astype(np.float64))


def rivals(
    name: str,
    plant: LoopPlant,
    telemetry: OpenLoopTelemetry,
    options: Mapping[str, Sequence[Any]] | None = None,
    gains: Sequence[float] = _GAINS,
) -> Iterator[partial[Rival]]:
    """Return a rival with all options and gains, fitted to telemetry."""
    from pyrtc.predictive import make_predictor  # type: ignore[import-untyped, unused-ignore]

    modes, options = plant.reconstructor.modes, _GRIDS[name] if options is None else options
    for matrix in (plant.reconstructor.matrix, plant.reconstructor.clean):
        to_modes = modes.T @ matrix
        history = (np.sign(telemetry.trust) * telemetry.open_loop_px) @ to_modes.T
        for values in itertools.product(*options.values()):
            chosen = {"type": name, "horizon": plant.delay_frames, **dict(zip(options, values, strict=True))}
            predictor = make_predictor(chosen, modes.shape[1]).fit(history)
            for gain in gains:
                yield partial(Rival, plant=plant, to_modes=to_modes, predictor=predictor, gain=gain)


def run() -> list[Table]:
    """Compare them with and without a vibration."""
    if importlib.util.find_spec("pyrtc") is None:
        return [Table("prediction", "Prediction", [], ["pyrtcao is not installed: nothing to compare with"])]
    return [table for vibration_nm in (0.0, VIBRATION_NM) for table in _tables(vibration_nm)]


def _tables(vibration_nm: float) -> tuple[Table, Table]:
    strehl: dict[tuple[str, float], Floats] = {}
    for photons in FLUXES:
        case = Case(photons, vibration_nm)
        for name, make in case.controllers(ours=photons == FLUXES[0]).items():
            each = (case.observed(make, realisation, FRAMES)[0] for realisation in range(REALISATIONS))
            strehl[name, photons] = np.array(list(each))
    own, rows = strehl[OURS, FLUXES[0]], []
    for (name, photons), runs in strehl.items():
        mean, ahead = paired_mean(runs), paired_mean(own - runs)
        values = {"Strehl": mean.value, "error": mean.standard_error}
        values |= {"learnt - it": ahead.value, "error of that": ahead.standard_error}
        rows.append(Row(f"{name}, {photons:g} photons", values))
    gains = []
    for name in _GRIDS:
        rising = np.maximum.accumulate([strehl[name, photons].mean() for photons in FLUXES])
        equal = np.interp(own.mean(), rising, np.log10(FLUXES))
        gain = 2.5 * float(equal - np.log10(FLUXES[0]))
        gains.append(Row(name, {"magnitudes": gain}, f">= {TARGET:g}", gain >= TARGET))
    about = f"vibration of {VIBRATION_NM:g} nm rms, 45 Hz" if vibration_nm else "no vibration"
    label, runs_note = f"prediction-{vibration_nm:g}", f"{REALISATIONS} realisations of {FRAMES} frames"
    note = f"at most {2.5 * np.log10(FLUXES[-1] / FLUXES[0]):.2f}, the range of the stars"
    return (
        Table(label, f"Strehl ratios, {about}", rows, [runs_note]),
        Table(f"{label}-gain", f"Gain over the rivals, {about}", gains, [note]),
    )
