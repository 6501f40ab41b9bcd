"""Loop of SPECULA: 27 Zernike modes of 6 x 6 lenslets in three layers, from the example's parameter file."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loops.foreign.base import SETTLE_FRAMES, Control, Floats, ForeignLoop, Observed
from faintspot.loop.slope_covariance import ARCSEC

EXAMPLES = Path(__file__).parents[3] / "examples"
_QUANTUM_EFFICIENCY = 0.01 / 40.0
"""For an electron a lenslet: the star's brightness is that of the example."""
_LONG_SCREEN = 4096  # points: 246 m, so that no layer comes round again
_SEEING_TO_R0 = 0.9759 * 500e-9
"""m rad: SPECULA's own product of seeing and r0."""


def example(name: str) -> Any:
    """Return an example as a module."""
    if str(EXAMPLES) not in sys.path:
        sys.path.insert(0, str(EXAMPLES))
    return importlib.import_module(name)


class SpeculaLoop(ForeignLoop):
    """Loop of SPECULA.

    Parameters
    ----------
    flux_e : float
        Electrons a lenslet and frame.
    own_slopes : bool
        Slopes of SPECULA's weighted centre of gravity in place of faintspot's window.
    """

    winds = [(8.0, 20.0), (12.0, 110.0), (20.0, 200.0)]  # noqa: RUF012
    sign, rate_hz, delay_frames, subaperture_m = -1.0, 250.0, 2, 0.6
    is_slow = True

    def __init__(self, flux_e: float, own_slopes: bool, folder: Path) -> None:
        self.name = f"specula-{flux_e:g}-{own_slopes}"
        self._example = example("specula_loop")
        self._example.run(self._example.SYSTEM, self._example.SUBAPERTURES)
        if own_slopes:
            setup = self._example.Setup("6 px", {"weightedPixRad": 3.0})
        else:
            tables = {
                "estimator": {"name": "window", "window_fwhm_px": 6.0},
                "settings": {"flux_e": flux_e},
            }
            setup = self._example.Setup("window", **tables)
        calibration = {**self._example.INTERACTION, "slopec_override": {**setup.keys, **setup.calibrating}}
        found = self._example.run(self._example.SYSTEM, calibration)
        self.interaction = self._matrix(found)
        self.own = {}  # its Modalrec is the inverse, its Integrator the one that is compared
        subapertures = found.objs["slopec"].subapdata
        pixels, side = np.asarray(subapertures.idxs), int(subapertures.np_sub)
        main = self._example.SYSTEM["main"]
        tilt = 4e-9 / (main["pixel_pupil"] * main["pixel_pitch"])  # Noll's first Zernike mode, 1 nm rms
        self.unit_arcsec = abs(tilt / np.median(self.interaction[: len(pixels), 0])) / ARCSEC
        self.r0_m = _SEEING_TO_R0 / (self._example.SEEING_ARCSEC * ARCSEC)
        self.cells = np.stack(np.divmod(pixels[:, 0], side * subapertures.nx), axis=1) // side
        self._settings = {"slopec_override": setup.keys}
        self._quantum_efficiency = flux_e * _QUANTUM_EFFICIENCY
        self._system = self._called(self._example.SYSTEM)

    def _called(self, system: dict[str, Any]) -> dict[str, Any]:
        """Return a system with the winds, and with a control that is called."""
        speeds, directions = (list(values) for values in zip(*self.winds, strict=True))
        constant = self._example.constant
        control = {
            "class": "CalledControl",
            "nmodes": self._example.MODES,
            "delay": 1,
            "inputs": {"in_slopes": "slopec.out_slopes"},
            "outputs": ["out_comm"],
        }
        own = {"wind_speed": constant(speeds), "wind_direction": constant(directions), "control": control}
        return {name: part for name, part in (system | own).items() if name != "rec"}

    def _matrix(self, ran: Any) -> Floats:
        """Return the interaction matrix of a calibration."""
        matrix = np.asarray(ran.objs["im_calibrator"].outputs["out_intmat"].get_value(), np.float64)
        return matrix if matrix.shape[1] == self._example.MODES else matrix.T

    def run(self, control: Control, seed: int, frames: int, *, turned: bool = False) -> Observed:
        """See `ForeignLoop`; the Strehl ratio is that of the long exposure."""
        if turned:
            raise ValueError("turned: SPECULA does not play turbulence backwards")
        from benchmarks.loops.foreign.specula_objects import (
            called_control,
        )  # after specula.init, in the example

        called_control.CONTROLS.append(control)
        loop = {
            "main_override": {
                "total_time": frames / self.rate_hz,
                "add_modules": ["faintspot.adapters.specula", "benchmarks.loops.foreign.specula_objects"],
            },
            "atmo_override": {"seed": seed, "heights": [0.0] * 3, "Cn2": [0.5, 0.3, 0.2]},
            "detector_override": {
                "photon_seed": seed + 1000,
                "readout_seed": seed + 2000,
                "quantum_eff": self._quantum_efficiency,
            },
            "psf_override": {"start_time": SETTLE_FRAMES / self.rate_hz},
            **self._settings,
        }
        ran = self._example.run(self._system, loop).objs
        called_control.CONTROLS.clear()
        noted = ran["control"]
        strehl = np.ravel(ran["psf"].outputs["out_int_sr"].value)[:1]
        return Observed(
            np.array(strehl, np.float64),
            np.array(noted.slopes),
            np.array(noted.commands),
            np.array(noted.predicting),
        )


def open_loop(seed: int, frames: int) -> tuple[Floats, Floats]:
    """Return noiseless frames of an open loop, and wavefronts that are NaN outside the pupil, m."""
    system = example("specula_loop")
    speeds, directions = (list(values) for values in zip(*SpeculaLoop.winds, strict=True))
    ran = system.run(
        {
            **system.SYSTEM,
            "wind_speed": system.constant(speeds),
            "wind_direction": system.constant(directions),
            "noted": {
                "class": "NotedFrames",
                "inputs": {"in_pixels": "detector.out_pixels", "in_ef": "prop.out_star_ef"},
            },
        },
        {
            "main_override": {
                "total_time": frames * 0.004,
                "add_modules": ["benchmarks.loops.foreign.specula_objects"],
            },
            "atmo_override": {
                "seed": seed,
                "heights": [0.0] * 3,
                "Cn2": [0.5, 0.3, 0.2],
                "pixel_phasescreens": _LONG_SCREEN,
            },
            "prop_override": {
                "inputs": {"atmo_layer_list": "atmo.layer_list", "common_layer_list": ["pupilstop"]}
            },
            "detector_override": {"photon_noise": False, "readout_noise": False},
            "remove": ["slopec", "rec", "control", "dm", "psf"],
        },
    ).objs["noted"]
    lit = np.asarray(ran.amplitude) > 0
    return np.array(ran.frames), np.where(lit, ran.paths_m, np.nan)
