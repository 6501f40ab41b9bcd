"""Simulated loops of various seeds, turbulence, flux, gain and delay, as recordings with their truth."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.prediction import Shaken
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.vibrations import Vibration
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop
from faintspot.loop.simulation.simulation import measure_gains
from faintspot.loop.simulation.telescope import TelescopeModel, make_pipeline
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.pipeline.settings import Settings

Floats = NDArray[np.float64]

SETTLE_FRAMES = 100
_FLUX_FRAMES = 50
_LEAK = 0.01
_WAVELENGTH_M = 500e-9


@dataclass(frozen=True)
class Case:
    """A loop with an integrator."""

    seed: int
    photons: float
    gain: float
    r0_m: float
    outer_scale_m: float
    delay_frames: int
    wind_factor: float
    wind_turn_deg: float
    from_hcipy: bool
    """Whether the turbulence is that of HCIPy's layers, which are extended row by row."""
    vibration: Vibration | None = None
    vibration_nm: float = 0.0
    """Rms over the square around the pupil."""
    frames: int = 3000

    def configuration(self) -> LoopConfiguration:
        """Return the loop, a variation of `diffraction_limit`."""
        plain = load_loop("diffraction_limit")
        speeds = tuple(self.wind_factor * each for each in plain.atmosphere.wind_speed_m_per_s)
        directions = tuple((each + self.wind_turn_deg) % 360 for each in plain.atmosphere.wind_direction_deg)
        air = {"r0_m": self.r0_m, "outer_scale_m": self.outer_scale_m}
        winds = {"wind_speed_m_per_s": speeds, "wind_direction_deg": directions}
        found = plain.replace("atmosphere", **air, **winds).replace("run", seed=self.seed)
        found = found.replace("camera", photons_per_subaperture=self.photons)
        return found.replace("control", delay_frames=self.delay_frames)


@dataclass(frozen=True, eq=False)
class Truth:
    """Values that the recording does not hold."""

    delay_frames: float
    noise_px: float
    """Rms of the slopes' standard errors, at the calibrated centroid gain."""
    r0_m: float
    outer_scale_m: float
    residual_nm: float
    """Rms residual wavefront in the second half, fitting error included."""
    winds_m_per_s: Floats
    """(layers, 2)"""
    shares: Floats
    """(layers,)"""
    vibration: Vibration | None = None
    vibration_nm: float = 0.0
    """Rms over a circle as wide as the pupil, in this recording."""


def drawn_cases(number: int, seed: int) -> list[Case]:
    """Return random cases, every second one with HCIPy's turbulence, the others with a vibration."""
    rng = np.random.default_rng(seed)
    cases = []
    for place in range(number):
        photons = float(np.exp(rng.uniform(math.log(20), math.log(300))))
        usual = 0.17 * (photons / 20) ** 0.37  # about the best gain
        cases.append(
            Case(
                int(rng.integers(1, 2**31)),
                photons,
                usual * rng.uniform(0.7, 1.2),
                rng.uniform(0.18, 0.32),
                float(np.exp(rng.uniform(math.log(12), math.log(50)))),
                int(rng.integers(1, 3, endpoint=True)),
                rng.uniform(0.6, 1.3),
                rng.uniform(0, 360),
                place % 2 == 1,
            )
        )
    rng = np.random.default_rng([seed, 45])
    return [case if case.from_hcipy else _with_vibration(case, rng) for case in cases]


def _with_vibration(case: Case, rng: np.random.Generator) -> Case:
    damping, rms_nm = (math.exp(rng.uniform(*np.log(each))) for each in ((0.002, 0.01), (30, 150)))
    vibration = Vibration(str(rng.choice(["tip", "tilt"])), rng.uniform(12, 110), damping, 1.0, 0.0, 0.0)
    return replace(case, vibration=vibration, vibration_nm=rms_nm)


def recorded(case: Case) -> tuple[Recording, Truth]:
    """Run the loop of a case; slopes by `window`, divided by the calibrated centroid gain."""
    configuration = case.configuration()
    telescope = TelescopeModel(configuration, case.seed)
    method = Method("window", Settings("window", flux_e=_seen_flux_e(configuration, telescope)))
    if case.from_hcipy:
        telescope.atmosphere = HcipyLayers(configuration, case.seed)  # type: ignore[assignment]
    optics, rate = telescope.optics, configuration.control.frame_rate_hz
    shaken_nm = 0.0
    if case.vibration is not None:
        known = case.vibration, case.vibration_nm, rate, [case.seed, 45], case.frames
        shaken = Shaken(telescope.atmosphere, *known)
        telescope.atmosphere = shaken  # type: ignore[assignment]
        # From a square to a circle of the same width.
        shaken_nm = math.sqrt(3) / 2 * float(shaken.values_nm[SETTLE_FRAMES : case.frames].std())
    pipeline = make_pipeline(configuration, optics.sensor, method)
    gain = float(measure_gains(configuration, [pipeline], seed=case.seed)[0])
    line = CommandDelayLine(optics.mirror.commands, case.delay_frames)
    controller = Integrator(line, optics.interaction, optics.reconstructor, case.gain, _LEAK)
    slopes, errors, commands, residual = [], [], [], []
    for frame in range(case.frames):
        after, seen = telescope.wavefronts((frame + 0.5) / rate, line.acting)
        found = pipeline(telescope.frame(frame, seen))
        error = np.concatenate([found.standard_error_x, found.standard_error_y]) / gain
        vector = found.vector.astype(np.float64) / gain
        controller.update(vector, error.astype(np.float64))
        vector[~np.tile(found.valid, 2)] = np.nan
        slopes.append(vector)
        errors.append(error)
        commands.append(line.latest.copy())
        residual.append(optics.pupil.rms(after))
    kept = np.square(np.array(errors)[SETTLE_FRAMES:])
    loop = Recording(
        np.array(slopes)[SETTLE_FRAMES:],
        np.array(commands)[SETTLE_FRAMES:],
        optics.interaction,
        optics.sensor.layout.cells,
        rate,
        subaperture_m=configuration.subaperture_m,
        pixel_scale_arcsec=configuration.pixel_scale_rad / ARCSEC,
        slope_unit="px",
        name="simulated",
    )
    air = configuration.atmosphere
    truth = Truth(
        case.delay_frames,
        float(np.sqrt(kept[np.isfinite(kept)].mean())),
        case.r0_m,
        case.outer_scale_m,
        float(np.sqrt(np.square(residual[SETTLE_FRAMES + len(kept) // 2 :]).mean())),
        winds_of(configuration),
        np.array(air.fraction) / sum(air.fraction),
        case.vibration,
        shaken_nm,
    )
    return loop, truth


def _seen_flux_e(configuration: LoopConfiguration, telescope: TelescopeModel) -> Floats:
    """Return the mean flux in the windows; some of each spot falls outside."""
    pipeline = make_pipeline(configuration, telescope.optics.sensor, Method("window", Settings("window")))
    flat = np.zeros_like(telescope.wavefronts(0.0, np.zeros(telescope.optics.mirror.commands))[1])
    fluxes = [pipeline(telescope.frame(frame, flat)).flux for frame in range(_FLUX_FRAMES)]
    return np.asarray(np.mean(fluxes, axis=0), np.float64)


def winds_of(configuration: LoopConfiguration) -> Floats:
    """Return the winds of a configuration, (layers, 2) m/s."""
    atmosphere = configuration.atmosphere
    angle = np.deg2rad(atmosphere.wind_direction_deg)
    speed = np.array(atmosphere.wind_speed_m_per_s)
    return np.asarray((speed * np.array([np.cos(angle), np.sin(angle)])).T)


class HcipyLayers:
    """HCIPy's infinite layers in place of our own screens."""

    def __init__(self, configuration: LoopConfiguration, seed: int) -> None:
        import hcipy

        atmosphere, sensor = configuration.atmosphere, configuration.sensor
        self._r0_m = float(np.mean(atmosphere.r0_m))
        points = sensor.subapertures * sensor.samples
        grid = hcipy.make_pupil_grid(points, configuration.width_m)
        share = np.array(atmosphere.fraction) / sum(atmosphere.fraction)
        strengths = self._r0_m * share ** (-3 / 5)
        # HCIPy moves the pupil over the turbulence: the wind has the opposite sign.
        self._layers: list[Any] = [
            hcipy.InfiniteAtmosphericLayer(
                grid,
                hcipy.Cn_squared_from_fried_parameter(float(r0), 500e-9),
                atmosphere.outer_scale_m,
                -wind,
                seed=seed + number,
            )
            for number, (r0, wind) in enumerate(zip(strengths, winds_of(configuration), strict=True))
        ]
        self._points = points

    def r0_m(self, time_s: float) -> float:
        """Return the Fried parameter at 500 nm."""
        return self._r0_m

    def wavefront_nm(self, time_s: float) -> NDArray[np.float32]:
        """Return the wavefront above the pupil, (points, points) nm."""
        total = np.zeros(self._points**2)
        for layer in self._layers:
            layer.evolve_until(time_s)
            total += layer.phase_for(_WAVELENGTH_M) * (_WAVELENGTH_M * 1e9 / (2 * np.pi))
        return np.asarray(total.reshape(self._points, -1) - total.mean(), np.float32)
