"""The error budget: what the Strehl ratio would be without one of the things that spoil it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import one_of
from faintspot.errors import InputError
from faintspot.loop.arms import arm_label, arm_named
from faintspot.loop.atmosphere import make_atmosphere
from faintspot.loop.calibration import centroid_gain, make_detector, make_pipeline, typical_spots
from faintspot.loop.configuration import CLOSED, LoopConfiguration
from faintspot.loop.control import Integrator
from faintspot.loop.magnitude import quick_run, tuned_choices
from faintspot.loop.record import Arm
from faintspot.loop.results import BUDGET_FILE, BudgetResult
from faintspot.loop.running import Advance, Unit, UnitStore, Workplace, run_units
from faintspot.loop.simulation import LoopOptics, prepare
from faintspot.loop.tuning import QUICK, Search
from faintspot.simulate.detector import Detector

KIND = "budget"
DEFAULT_ARMS = ("brightest", "smoothed", "tv")
TERM_MEANINGS = {
    "nothing": "the loop as it is",
    "photon and read noise": "mean light in every pixel",
    "servo lag": "ten times the frame rate, as much light in every frame, in stretches over the same time",
    "fitting and aliasing": "the wavefront is only what the mirror can make",
    "centroid gain error": "slopes are divided by the gain that they had in the run",
    "slope error": "slopes are the mean gradients of the wavefront",
    "slope error and servo lag": "both",
}
"""What is switched off, and how."""
TERMS = tuple(TERM_MEANINGS)

_FASTER = 10.0
_STRETCH_FRAMES = 100
_STRETCH_SETTLE_FRAMES = 40

Floats = NDArray[np.float64]


def run_budget(
    configuration: LoopConfiguration,
    folder: str | Path,
    arms: Sequence[str] | None = None,
    *,
    quick: bool = False,
    search: Search | None = None,
    place: Workplace | None = None,
    overwrite: bool = False,
) -> BudgetResult:
    """Measure the Strehl ratio of arms with each of `TERM_MEANINGS` switched off, or what is left of it.

    Each arm is tuned as for `run_magnitude`, at the configuration's own light with everything on, and keeps
    these settings and its loop gain throughout. The result is also written to the folder.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Where finished units are remembered; made where it is not there.
    arms : sequence of str, optional
        Of `faintspot.loop.arms.ARM_NAMES`. Default: brightest pixels, Gaussian smoothing and TV.
    quick, search, place, overwrite
        As for `run_magnitude`.

    Raises
    ------
    InputError
        For unknown arms, a folder that holds another experiment, or a loop that is open.
    MissingExtraError
        When HCIPy, or Dask where it is needed, is not installed.
    """
    if configuration.control.mode != CLOSED:
        raise InputError(
            f"control.mode = {configuration.control.mode!r}: expected 'closed' for an error budget"
        )
    place = Workplace() if place is None else place
    configuration = quick_run(configuration) if quick else configuration
    search = search or (QUICK if quick else Search())
    names = list(dict.fromkeys(DEFAULT_ARMS if arms is None else arms))
    labels = tuple(arm_label(name) for name in names)
    if not names:
        raise InputError("arms: expected at least one, got none")
    store = UnitStore(folder, KIND, f"{configuration.to_text()}\n{asdict(search)}", overwrite=overwrite)
    choices = tuned_choices(configuration, names, [configuration.photons], search, store, place)
    runs = range(configuration.run.realisations)
    units = [
        Unit(_key(name, term, run), (name, configuration, choice, term, run), configuration.run.frames)
        for (name, _), choice in choices.items()
        for term in TERMS
        for run in runs
    ]
    place.say("scoring")
    results = run_units(budget_run, units, store, place)

    def of(variable: str) -> Floats:
        return np.array(
            [[[results[_key(name, term, run)][variable] for run in runs] for term in TERMS] for name in names]
        )

    result = BudgetResult(TERMS, labels, of("strehl"), of("residual_nm"))
    result.save(store.folder / BUDGET_FILE)
    return result


def _key(name: str, term: str, realisation: int) -> str:
    return f"score-{name}-{TERMS.index(term)}-{realisation}"


def budget_run(
    name: str,
    configuration: LoopConfiguration,
    choice: Mapping[str, float],
    term: str,
    realisation: int,
    advance: Advance,
) -> dict[str, NDArray[Any]]:
    """Run a tuned arm once with a term switched off; Strehl ratio and rms wavefront as arrays.

    Raises
    ------
    InputError
        For an unknown arm or term.
    """
    one_of("term", term, TERMS)
    arm = arm_named(name, configuration, choice)
    if term == "centroid gain error":
        first = _Run(configuration, arm, "nothing", realisation)
        first.run(lambda frames: None)
        again = _Run(configuration, arm, term, realisation)
        again.gain = first.gain_in_run()
        return again.run(advance)
    return _Run(configuration, arm, term, realisation).run(advance)


@dataclass(frozen=True, eq=False)
class _Noiseless:
    """A detector without photon noise, read noise and quantisation."""

    detector: Detector

    def expose(self, mean_e: Floats, rng: np.random.Generator | None = None) -> NDArray[np.float32]:
        camera = self.detector
        light = mean_e + camera.background_e + camera.dark_e
        adu = camera.offset_adu + light * camera.em_gain / camera.gain_e_per_adu
        return adu.astype(np.float32)


class _Correctable:
    """What the mirror can make of wavefronts: least squares over the pupil."""

    def __init__(self, optics: LoopOptics) -> None:
        self._shape = (optics.pupil.points,) * 2
        weight = optics.pupil.amplitude.ravel()[:, None]
        self._modes, _, _ = np.linalg.svd(np.sqrt(weight) * optics.mirror.matrix(), full_matrices=False)
        root = np.sqrt(weight[:, 0])
        self._root, self._inverse = root, np.where(root > 0, 1 / np.where(root > 0, root, 1), 0)

    def __call__(self, wavefront: NDArray[np.float32]) -> NDArray[np.float32]:
        seen = self._modes.T @ (self._root * wavefront.ravel())
        kept: NDArray[np.float32] = (self._inverse * (self._modes @ seen)).reshape(self._shape)
        return kept.astype(np.float32)


class _Run:
    """One run of the loop with a term switched off."""

    def __init__(self, configuration: LoopConfiguration, arm: Arm, term: str, realisation: int) -> None:
        lag_off = term in ("servo lag", "slope error and servo lag")
        if lag_off:
            rate = configuration.control.frame_rate_hz * _FASTER
            camera = {"photons_per_subaperture": configuration.photons, "magnitude": None}
            configuration = configuration.replace("camera", **camera).replace("control", frame_rate_hz=rate)
        self.configuration, self.arm, self.realisation = configuration, arm, realisation
        self.faster = lag_off
        self.true_slopes = term.startswith("slope error")
        self.optics = prepare(configuration)
        self.air = make_atmosphere(configuration, configuration.run.seed, realisation)
        self.filter = _Correctable(self.optics) if term == "fitting and aliasing" else None
        detector = make_detector(configuration)
        self.detector: Any = _Noiseless(detector) if term == "photon and read noise" else detector
        self.pipeline = make_pipeline(configuration, self.optics.sensor, arm)
        self.gain = 1.0
        if arm.correct_gain and not self.true_slopes:
            self.gain = self._calibrated_gain()
        self.controller = Integrator(configuration.control, self.optics.mirror.commands)
        self._sums = np.zeros(2)

    def run(self, advance: Advance) -> dict[str, NDArray[Any]]:
        """Run all frames."""
        run = self.configuration.run
        steps = []
        for frame in range(run.frames):
            steps.append(self._step(frame))
            advance(frame + 1)
        truth = np.array(steps)[[self._scored(frame) for frame in range(run.frames)]]
        return {
            "strehl": np.asarray(truth[:, 0].mean()),
            "residual_nm": np.asarray(np.sqrt(np.mean(truth[:, 1] ** 2))),
        }

    def gain_in_run(self) -> float:
        """Return the regression of the measured slopes on the true ones."""
        return float(self._sums[0] / self._sums[1])

    def _calibrated_gain(self) -> float:
        """Return the centroid gain at the run's flux, as the loop itself measures it."""
        optics, configuration = self.optics, self.configuration
        spots = typical_spots(
            configuration, optics.sensor, optics.mirror, self.air, optics.reconstructor.matrix
        )
        seed = configuration.run.seed
        return centroid_gain(self.pipeline, optics.sensor, self.detector, configuration.photons, spots, seed)

    def _step(self, frame: int) -> tuple[float, float]:
        """Simulate one frame; its Strehl ratio and the rms of its wavefront, nm."""
        configuration, optics, arm = self.configuration, self.optics, self.arm
        wavefront = self._air(frame) + optics.mirror.wavefront_nm(self.controller.acting)
        true = optics.sensor.mean_slopes_px(wavefront)
        measured, error = true, np.ones(len(true))
        if not self.true_slopes:
            measured, error = self._measure(frame, wavefront)
        if self._scored(frame):
            self._sums += measured @ true, true @ true
        if arm.weighted_reconstructor:
            commands = optics.reconstructor.weighted(measured / self.gain, error)
        else:
            commands = optics.reconstructor(measured / self.gain)
        self.controller.update(commands, configuration.control.gain if arm.gain is None else arm.gain)
        field = optics.pupil.field(wavefront, configuration.science.wavelength_m)
        return optics.pupil.strehl(field), optics.pupil.rms(wavefront)

    def _scored(self, frame: int) -> bool:
        settled = not self.faster or frame % _STRETCH_FRAMES >= _STRETCH_SETTLE_FRAMES
        return settled and frame >= self.configuration.run.settle_frames

    def _time_s(self, frame: int) -> float:
        """Return the middle of a frame; a faster loop sees as much of the air, but not all of it."""
        rate = self.configuration.control.frame_rate_hz
        if not self.faster:
            return (frame + 0.5) / rate
        first = frame - frame % _STRETCH_FRAMES
        return first * _FASTER / rate + (frame - first + 0.5) / rate

    def _air(self, frame: int) -> NDArray[np.float32]:
        air = self.air.wavefront_nm(self._time_s(frame))
        return air if self.filter is None else self.filter(air)

    def _measure(self, frame: int, wavefront: NDArray[np.float32]) -> tuple[Floats, Floats]:
        """Return slopes and their standard errors, px, of the frame that the sensor's camera takes."""
        sensor, run = self.optics.sensor, self.configuration.run
        light = sensor.frame(sensor.spots(wavefront)) * self.configuration.photons
        prior = self.optics.interaction @ self.controller.expected() if self.arm.predict_prior else None
        # The same noise as in `simulate_loop`.
        rng = np.random.default_rng([run.seed, self.realisation, frame, 2])
        slopes = self.pipeline(self.detector.expose(light, rng), prior)
        error = np.concatenate([slopes.standard_error_x, slopes.standard_error_y])
        return slopes.vector.astype(np.float64), error.astype(np.float64)
