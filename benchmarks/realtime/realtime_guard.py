"""Does the guard open loops that diverge, and no others?

The engine's loop with a fixed window behind the simulated telescope, integrator, frame by frame without a
clock. After 200 frames something happens; a loop that has not opened within 300 more counts as closed.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.measuring import Row, Table
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.simulation import Method, load_loop
from faintspot.loop.simulation.simulation import measure_gains
from faintspot.loop.simulation.telescope import TelescopeModel, make_pipeline
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slopes import Slopes

OPEN_FRAMES, BEFORE, AFTER, REALISATIONS = 60, 200, 300, 3
LOOPS = {("diffraction_limit", 20.0): (2.2, 0.16), ("diffraction_limit", 100.0): (2.2, 0.43)}
LOOPS |= {("camera_3e", 60.0): (4.0, 0.25)}
"""Width of the window [px] and loop gain, by configuration and photons."""
_BAD_PX = 4.0


class GuardedRun:
    """An engine's loop behind a telescope model."""

    def __init__(self, name: str, photons: float, realisation: int) -> None:
        width_px, gain = LOOPS[name, photons]
        self.configuration = load_loop(name).replace(
            "camera", photons_per_subaperture=photons, magnitude=None
        )
        self.telescope = TelescopeModel(self.configuration, self.configuration.run.seed, realisation)
        optics = self.telescope.optics
        settings = Settings("window", window_fwhm_px=width_px, flux_e=photons)
        self._pipeline = make_pipeline(self.configuration, optics.sensor, Method("window", settings))
        centroid_gain = measure_gains(
            self.configuration, [self._pipeline], seed=self.configuration.run.seed
        ).item()
        control = self.configuration.control
        options = ControlOptions(
            gain=gain,
            leak=control.leak,
            delay_frames=control.delay_frames,
            centroid_gain=centroid_gain,
        )
        self.loop = ControlLoop(Control(optics.interaction, None, options), optics.sensor.layout)
        self.sent = [np.zeros(optics.mirror.commands)] * control.delay_frames
        self.sign, self.bad = 1.0, 0
        self._number, self._rng = 0, np.random.default_rng(realisation)

    def frames(self, count: int) -> tuple[int, float]:
        """Let frames come while the loop is as it is; return their number and mean Strehl ratio."""
        closed, strehl = self.loop.closed, list[float]()
        while len(strehl) < count and self.loop.closed == closed:
            time_s = (self._number + 0.5) / self.configuration.control.frame_rate_hz
            after, seen = self.telescope.wavefronts(time_s, self.sign * self.sent.pop(0))
            strehl.append(self.telescope.truth(time_s, after).strehl)
            slopes = self._seen(self._pipeline(self.telescope.frame(self._number, seen)))
            self.sent.append(self.loop.follow(slopes, self._number).copy())
            self.loop.look_after(slopes.flux)
            self._number += 1
        return len(strehl), float(np.mean(strehl))

    def _seen(self, slopes: Slopes) -> Slopes:
        """Return the slopes, or those of a bad frame."""
        if self.bad <= 0:
            return slopes
        self.bad -= 1
        x, y = _BAD_PX * self._rng.choice([-1.0, 1.0], (2, len(slopes.x)))
        return replace(slopes, x=x.astype(np.float32), y=y.astype(np.float32))


def _fades(run: GuardedRun) -> None:
    run.telescope.photons *= 10 ** (-0.4 * 2)


def _is_worse(run: GuardedRun) -> None:
    r0_m = 0.5 * float(np.mean(run.configuration.atmosphere.r0_m))
    run.telescope.atmosphere = replace(run.telescope.atmosphere, r0_range_m=(r0_m, r0_m))


def _blows(run: GuardedRun) -> None:
    atmosphere, rate = run.telescope.atmosphere, run.configuration.control.frame_rate_hz
    run.telescope.atmosphere = atmosphere.blown(10 * atmosphere.velocity, run._number / rate)


def _jumps(run: GuardedRun) -> None:
    away = 8000.0 * np.random.default_rng(1).standard_normal(len(run.sent[0]))
    run.loop._line.hold(away)
    run.sent = [away] * len(run.sent)


EVENTS: dict[str, Callable[[GuardedRun], None]] = {
    "gain times 8": lambda run: setattr(run.loop, "gain", min(2.0, 8 * (run.loop.gain or 0.0))),
    "wrong sign": lambda run: setattr(run, "sign", -1.0),
    "mirror jumps by 8 um rms": _jumps,
    "one bad frame": lambda run: setattr(run, "bad", 1),
    "ten bad frames": lambda run: setattr(run, "bad", 10),
    "star fades by 2 magnitudes": _fades,
    "r0 half as large": _is_worse,
    "winds 10 times as fast": _blows,
    "nothing": lambda run: None,
}


def run() -> list[Table]:
    """Let every event happen to every loop."""
    tables = []
    for name, photons in LOOPS:
        rows = [_row(name, photons, event) for event in EVENTS]
        title = f"Guard: {name}, {photons:g} photons"
        note = f"{REALISATIONS} realisations; fixed window, integrator"
        tables.append(Table(f"realtime-guard-{name}-{photons:g}", title, rows, [note]))
    return tables


def _row(name: str, photons: float, event: str) -> Row:
    found = []
    for realisation in range(REALISATIONS):
        run = GuardedRun(name, photons, realisation)
        run.frames(OPEN_FRAMES)
        run.loop.close()
        run.frames(BEFORE)
        EVENTS[event](run)
        frames, strehl = run.frames(AFTER)
        found.append((run.loop.closed, frames, strehl))
    closed, frames, strehl = np.array(found, np.float64).T
    opened = frames[closed == 0]
    values = {
        "opened, part": float(1 - closed.mean()),
        "after, frames": float(np.median(opened)) if len(opened) else float("nan"),
        "Strehl ratio until then": float(strehl.mean()),
    }
    return Row(event, values)
