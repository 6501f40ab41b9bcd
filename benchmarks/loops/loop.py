"""The closed loop: frames per second, where the time goes, and how best to move the air over the pupil.

HCIPy's own layers are timed against the screens of `telescope.atmosphere`. What the interpolation of
these does is measured with true slopes, so that nothing but the air differs: steps of whole points keep all
small structures, but the air stands still for some frames and jumps in others; linear interpolation takes
structures off, the more the farther from the points.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table, absolute_spread, best, interleaved, pinned
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop, simulate_loop
from faintspot.loop.simulation.atmosphere import MovingLayers, make_atmosphere
from faintspot.loop.simulation.telescope import LoopOptics, make_detector, make_pipeline, prepare
from faintspot.loop.simulation.wavefront_sensor import pupil_grid, require_hcipy

TARGET_FRAMES_PER_S = 80.0
FRAMES = 400
BRIGHTEST = fs.Settings("brightest", keep_brightest=80)
TV = fs.Settings("tv", noise_std=0.3, keep_brightest=80)

Wavefront = NDArray[np.float32]


class WholePoints(MovingLayers):
    """Air that moves by whole points."""

    def shifted(self, screen: Wavefront, corner: NDArray[np.float64]) -> Wavefront:
        """Return the nearest points of a screen."""
        row, column = np.rint(corner).astype(int)
        rows, columns = (start + np.arange(self.points) for start in (row, column))
        return np.asarray(screen.take(rows, 0, mode="wrap").take(columns, 1, mode="wrap"))


class Linear(MovingLayers):
    """Air that moves by linear interpolation between points."""

    def shifted(self, screen: Wavefront, corner: NDArray[np.float64]) -> Wavefront:
        """Return the mean of four neighbours, by distance."""
        row, column = np.floor(corner).astype(int)
        down, right = (corner - np.floor(corner)).astype(np.float32)
        rows, columns = (start + np.arange(self.points + 1) for start in (row, column))
        part = screen.take(rows, 0, mode="wrap").take(columns, 1, mode="wrap")
        mixed = (1 - down) * part[:-1] + down * part[1:]
        return np.asarray((1 - right) * mixed[:, :-1] + right * mixed[:, 1:])


def hcipy_layers(configuration: LoopConfiguration, kind: str) -> Any:
    """Return layers of HCIPy: "infinite" (interpolated by splines), "whole" (without) or "finite"."""
    hcipy = require_hcipy("the benchmark of the loop")
    atmosphere, grid = configuration.atmosphere, pupil_grid(configuration)
    r0 = atmosphere.r0_m if isinstance(atmosphere.r0_m, float) else atmosphere.r0_m[0]
    strength = hcipy.Cn_squared_from_fried_parameter(r0)
    layers = []
    for number, part in enumerate(atmosphere.fraction):
        angle = np.deg2rad(atmosphere.wind_direction_deg[number])
        velocity = atmosphere.wind_speed_m_per_s[number] * np.array([np.cos(angle), np.sin(angle)])
        common = (grid, strength * part, atmosphere.outer_scale_m, velocity)
        if kind == "finite":
            layers.append(hcipy.FiniteAtmosphericLayer(*common, oversampling=8, seed=number))
        else:
            whole = kind == "whole"
            layers.append(hcipy.InfiniteAtmosphericLayer(*common, use_interpolation=not whole, seed=number))
    return hcipy.MultiLayerAtmosphere(layers)


def strehl_with_true_slopes(
    optics: LoopOptics, atmosphere: MovingLayers, configuration: LoopConfiguration
) -> float:
    """Return the mean Strehl ratio of a loop without noise, whose slopes are the mean gradients."""
    control = configuration.control
    line = CommandDelayLine(optics.mirror.commands, control.delay_frames)
    integrator = Integrator(line, optics.interaction, optics.reconstructor, 0.5, control.leak)
    errors = np.ones(len(optics.interaction))
    strehl = np.zeros(FRAMES)
    for frame in range(FRAMES):
        wavefront = atmosphere.wavefront_nm((frame + 0.5) / configuration.control.frame_rate_hz)
        wavefront = wavefront + optics.mirror.wavefront_nm(line.acting)
        field = optics.pupil.field(wavefront, configuration.science.wavelength_m)
        strehl[frame] = optics.pupil.strehl(field)
        integrator.update(optics.sensor.mean_slopes_px(wavefront), errors)
    return float(strehl[50:].mean())


def atmosphere_table(configuration: LoopConfiguration) -> Table:
    """Compare ways to move the air."""
    optics = prepare(configuration)
    airs = [make_atmosphere(configuration, 1, number) for number in range(3)]
    kinds: dict[str, type[MovingLayers]] = {
        "four points (used)": MovingLayers,
        "linear": Linear,
        "whole points": WholePoints,
    }
    moved = {name: [kind(**vars(atmosphere)) for atmosphere in airs] for name, kind in kinds.items()}
    theirs = {f"HCIPy {kind}": hcipy_layers(configuration, kind) for kind in ("infinite", "whole", "finite")}
    clock = iter(range(10**9))

    def step_of(layers: Any) -> Any:
        return lambda: (layers.evolve_until(next(clock) / 250 / 20), layers.phase_for(1e-6))

    def ours(atmosphere: MovingLayers) -> Any:
        return lambda: atmosphere.wavefront_nm(next(clock) / 250)

    candidates = {name: ours(each[0]) for name, each in moved.items()}
    with pinned():
        times = interleaved({**candidates, **{name: step_of(layers) for name, layers in theirs.items()}})
    rows = []
    for name in times:
        values = {"ms a frame": best(times, name) * 1e3}
        if name in moved:
            runs = [strehl_with_true_slopes(optics, atmosphere, configuration) for atmosphere in moved[name]]
            values["Strehl, true slopes"] = float(np.mean(runs))
            values["rms nm within 2 points"] = float(
                np.mean([_roughness(atmosphere) for atmosphere in moved[name]])
            )
        rows.append(Row(name, values))
    return Table("air", f"Wavefront of {len(configuration.atmosphere.fraction)} layers", rows)


def _roughness(atmosphere: MovingLayers) -> float:
    """Return the rms difference of points next but one, over a second."""
    fronts = [atmosphere.wavefront_nm(time) for time in np.arange(0, 1, 0.037)]
    return float(np.sqrt(np.mean([np.mean((front[2:] - front[:-2]) ** 2) for front in fronts])))


def parts_table(configuration: LoopConfiguration) -> Table:
    """Time the parts of a frame."""
    optics, detector = prepare(configuration), make_detector(configuration)
    atmosphere = make_atmosphere(configuration, 1)
    wavefront = atmosphere.wavefront_nm(0.1) * np.float32(0.3)
    flux = optics.sensor.frame(optics.sensor.spots(wavefront)) * configuration.photons
    frame = detector.expose(flux, np.random.default_rng(1))
    pipelines = {
        name: make_pipeline(configuration, optics.sensor, Method(name, settings))
        for name, settings in (("brightest", BRIGHTEST), ("TV", TV))
    }
    commands, slopes = np.ones(optics.mirror.commands), np.ones(2 * len(optics.sensor.layout))
    parts: dict[str, Any] = {
        "air": lambda: atmosphere.wavefront_nm(0.1),
        "mirror": lambda: optics.mirror.wavefront_nm(commands),
        "spots": lambda: optics.sensor.spots(wavefront),
        "detector": lambda: detector.expose(flux, np.random.default_rng(1)),
        "pipeline, brightest": lambda: pipelines["brightest"](frame),
        "pipeline, TV": lambda: pipelines["TV"](frame),
        "reconstructor": lambda: optics.reconstructor(slopes),
        "weighted reconstructor": lambda: optics.reconstructor.weighted(slopes, slopes),
        "science field": lambda: optics.pupil.field(wavefront, configuration.science.wavelength_m),
    }
    with pinned():
        times = interleaved(parts)
    rows = [Row(name, {"ms a frame": best(times, name) * 1e3}) for name in parts]
    return Table("parts", f"Parts of a frame of {configuration.name}", rows)


def run() -> list[Table]:
    """Time the loop."""
    configuration = load_loop("emccd")
    short = replace(configuration, run=replace(configuration.run, frames=FRAMES))
    simulate_loop(short, [Method("brightest", BRIGHTEST)])  # makes screens and calibration, compiles
    methods = {"brightest": Method("brightest", BRIGHTEST), "TV": Method("TV", TV)}

    def runs(method: Method) -> Any:
        return lambda: simulate_loop(short, [method])

    with pinned():
        times = interleaved({name: runs(method) for name, method in methods.items()}, fewest=3)
    rows = []
    for name in methods:
        rate = FRAMES / best(times, name)
        target = f"at least {TARGET_FRAMES_PER_S:g}"
        known = {"frames/s": absolute_spread(times, name)}
        rows.append(Row(name, {"frames/s": rate}, target, rate >= TARGET_FRAMES_PER_S, known))
    notes = ["measuring the centroid gain (120 frames) is part of each run"]
    loop = Table("loop", "Loop frames per second of a 4.2 m telescope, 7 x 7, one core", rows, notes)
    return [loop, parts_table(configuration), atmosphere_table(configuration)]
