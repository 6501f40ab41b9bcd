"""Loops of SPECULA with its modulated pyramid, of which faintspot is told no geometry."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loops.foreign.base import Control, Observed
from benchmarks.loops.foreign.oopao import OopaoCase
from benchmarks.loops.foreign.specula import SpeculaLoop, example

_POINTS, _PITCH_M = 40, 0.09
"""Points across the pupil, and their distance: fewer than with lenslets, for speed."""
_FRAME_PX = 32
_PYRAMID = {
    "class": "ModulatedPyramid",
    "simul_params_ref": "main",
    "wavelengthInNm": 650,
    "fov": 1.4,
    "pup_diam": 12,
    "pup_dist": 16,
    "output_resolution": _FRAME_PX,
    "mod_amp": 3.0,
    "mod_step": 20,
    "inputs": {"in_ef": "prop.out_star_ef"},
    "outputs": ["out_i"],
}
_SLOPES = {
    "class": "PyrSlopec",
    "pupdata_object": "pupils",
    "inputs": {"in_pixels": "detector.out_pixels"},
    "outputs": ["out_slopes"],
}
_PUPILS = {
    "pupils": {
        "class": "PyrPupdataCalibrator",
        "output_tag": "pupils",
        "overwrite": True,
        "inputs": {"in_pixels": "detector.out_pixels"},
    },
    "main_override": {"total_time": 0.004},
    "prop_override": {"inputs": {"common_layer_list": ["pupilstop"]}},
    "detector_override": {"photon_noise": False, "readout_noise": False},
    "remove": ["atmo", "slopec", "rec", "control", "dm", "psf"],
}
_POKE_NM = 5.0
_LINE_HZ, _DAMPING, _LINE_POINTS = 45.0, 0.005, 4001


class SpeculaPyramidLoop(SpeculaLoop):
    """Loop of SPECULA with a pyramid.

    Parameters
    ----------
    case : OopaoCase
        Its flux, read noise and vibration; the flux is that of the whole frame.
    folder : Path
    """

    is_modal = True

    def __init__(self, case: OopaoCase, folder: Path) -> None:
        self.name, self.own, self.unit_arcsec = f"specula-pyramid-{case.name}", {}, math.nan
        self.cells = np.zeros((0, 2), np.int64)
        self._example, self._vibration_nm = example("specula_loop"), case.vibration_nm
        parts = self._example.SYSTEM
        detector = {**parts["detector"], "size": [_FRAME_PX] * 2, "readout_level": case.read_noise_e}
        system = {
            **parts,
            "main": {**parts["main"], "pixel_pupil": _POINTS, "pixel_pitch": _PITCH_M},
            "sh": _PYRAMID,
            "slopec": _SLOPES,
            "detector": detector,
        }
        frame = self._example.run(system, _PUPILS).objs["detector"].outputs["out_pixels"].pixels
        self._quantum_efficiency = detector["quantum_eff"] * case.flux_e / float(np.sum(frame))
        pokes = {"pushpull_override": {"vect_amplitude": [_POKE_NM] * self._example.MODES}}
        self.interaction = self._matrix(self._example.run(system, {**self._example.INTERACTION, **pokes}))
        self.r0_m = math.nan
        self._system, self._settings = self._called(system), {}

    def run(self, control: Control, seed: int, frames: int, *, turned: bool = False) -> Observed:
        """See `ForeignLoop`."""
        if self._vibration_nm:
            self._system |= self._shaken(seed)
            layers = ["pupilstop", "dm.out_layer:-1", "shaker.out_layer"]
            inputs = {"atmo_layer_list": "atmo.layer_list", "common_layer_list": layers}
            self._settings = {"prop_override": {"inputs": inputs}}
        return super().run(control, seed, frames, turned=turned)

    def _shaken(self, seed: int) -> dict[str, Any]:
        """Return a mirror that tips with a line of 45 Hz."""
        frequency = np.linspace(0, self.rate_hz / 2, _LINE_POINTS)
        ratio = frequency / _LINE_HZ
        power = 1 / ((1 - ratio**2) ** 2 + (2 * _DAMPING * ratio) ** 2)
        power *= self._vibration_nm**2 / (power.sum() * frequency[1])
        line = {
            "class": "VibrationGenerator",
            "simul_params_ref": "main",
            "nmodes": 1,
            "psd": [power.tolist()],
            "freq": frequency.tolist(),
            "seed": seed,
            "outputs": ["output"],
        }
        mirror = {**self._example.SYSTEM["dm"], "nmodes": 1, "inputs": {"in_command": "line.output"}}
        return {"line": line, "shaker": mirror}
