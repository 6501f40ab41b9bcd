"""faintspot in a SPECULA closed loop: its slopes beside SPECULA's own, for a faint star.

A 3.6 m telescope, 6x6 lenslets of 10x10 pixels, about 40 electrons per lenslet and frame, 250 frames/s, 1
electron of read noise. In the parameter file the class of the slope computer changes (and `add_modules` says
where it is); in the file that calibrates, it says `calibrating`. Every method has a reconstructor of its own
and is tuned on other air than it is judged by.
"""

import logging
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import specula
import yaml
from loop_table import compare

specula.init(-1, precision=1, log_level=logging.ERROR)

from specula.simul import Simul  # noqa: E402 - after specula.init

SEEING_ARCSEC, WIND_M_S, MODES, FRAMES, FLUX_E = 0.7, 12.0, 27, 120, 40.0
GAINS = (0.25, 0.45, 0.65)
FOLDER = Path(tempfile.mkdtemp())


def constant(value: Any) -> dict[str, Any]:
    """Return SPECULA's generator of a constant."""
    return {"class": "WaveGenerator", "constant": value, "outputs": ["output"]}


SYSTEM = {
    "main": {
        "class": "SimulParams",
        "root_dir": str(FOLDER),
        "pixel_pupil": 60,
        "pixel_pitch": 0.06,
        "total_time": 0.004 * FRAMES,
        "time_step": 0.004,
        "add_modules": ["faintspot.adapters.specula"],
    },
    "seeing": constant(SEEING_ARCSEC),
    "wind_speed": constant([WIND_M_S]),
    "wind_direction": constant([20.0]),
    "star": {"class": "Source", "polar_coordinates": [0.0, 0.0], "magnitude": 9.3, "wavelengthInNm": 650},
    "pupilstop": {"class": "Pupilstop", "simul_params_ref": "main", "obs_diam": 0.2},
    "atmo": {
        "class": "AtmoEvolution",
        "simul_params_ref": "main",
        "L0": 25,
        "heights": [0.0],
        "Cn2": [1.0],
        "pixel_phasescreens": 1024,
        "seed": 1,
        "inputs": {
            "seeing": "seeing.output",
            "wind_speed": "wind_speed.output",
            "wind_direction": "wind_direction.output",
        },
        "outputs": ["layer_list"],
    },
    "prop": {
        "class": "AtmoPropagation",
        "simul_params_ref": "main",
        "source_dict_ref": ["star"],
        "inputs": {
            "atmo_layer_list": "atmo.layer_list",
            "common_layer_list": ["pupilstop", "dm.out_layer:-1"],
        },
        "outputs": ["out_star_ef"],
    },
    "sh": {
        "class": "SH",
        "subap_wanted_fov": 1.1,
        "sensor_pxscale": 0.11,
        "subap_npx": 10,
        "subap_on_diameter": 6,
        "wavelengthInNm": 650,
        "inputs": {"in_ef": "prop.out_star_ef"},
        "outputs": ["out_i"],
    },
    "detector": {
        "class": "CCD",
        "simul_params_ref": "main",
        "size": [60, 60],
        "dt": 0.004,
        "bandw": 300,
        "photon_noise": True,
        "readout_noise": True,
        "readout_level": 1.0,
        "quantum_eff": 0.01,
        "inputs": {"in_i": "sh.out_i"},
        "outputs": ["out_pixels"],
    },
    "slopec": {
        "class": "ShSlopec",
        "subapdata_object": "subaps",
        "inputs": {"in_pixels": "detector.out_pixels"},
        "outputs": ["out_slopes"],
    },
    "rec": {
        "class": "Modalrec",
        "recmat_object": "rec",
        "inputs": {"in_slopes": "slopec.out_slopes"},
        "outputs": ["out_modes"],
    },
    "control": {
        "class": "Integrator",
        "delay": 1,
        "int_gain": [0.3] * MODES,
        "inputs": {"delta_comm": "rec.out_modes"},
        "outputs": ["out_comm"],
    },
    "dm": {
        "class": "DM",
        "simul_params_ref": "main",
        "type_str": "zernike",
        "nmodes": MODES,
        "obsratio": 0.2,
        "height": 0,
        "inputs": {"in_command": "control.out_comm"},
        "outputs": ["out_layer"],
    },
    "psf": {
        "class": "PSF",
        "simul_params_ref": "main",
        "wavelengthInNm": 1650,
        "nd": 2,
        "start_time": 0.16,
        "inputs": {"in_ef": "prop.out_star_ef"},
        "outputs": ["out_int_sr"],
    },
}
NOISE_FREE = {"photon_noise": False, "readout_noise": False}
SUBAPERTURES = {
    "sh_subaps": {
        "class": "ShSubapCalibrator",
        "subap_on_diameter": 6,
        "output_tag": "subaps",
        "energy_th": 0.5,
        "overwrite": True,
        "inputs": {"in_i": "sh.out_i"},
    },
    "main_override": {"total_time": 0.004},
    "prop_override": {"inputs": {"common_layer_list": ["pupilstop"]}},
    "remove": ["atmo", "slopec", "rec", "control", "dm", "psf"],
}
INTERACTION = {
    "pushpull": {
        "class": "PushPullGenerator",
        "nmodes": MODES,
        "vect_amplitude": [20.0] * MODES,
        "outputs": ["output"],
    },
    "main_override": {"total_time": 0.004 * 2 * MODES},
    "prop_override": {"inputs": {"common_layer_list": ["pupilstop", "dm.out_layer"]}},
    "dm_override": {"sign": 1, "inputs": {"in_command": "pushpull.output"}},
    "detector_override": NOISE_FREE,
    "im_calibrator": {
        "class": "ImCalibrator",
        "nmodes": MODES,
        "im_tag": "im",
        "overwrite": True,
        "inputs": {"in_slopes": "slopec.out_slopes", "in_commands": "pushpull.output"},
        "outputs": ["out_intmat"],
    },
    "rec_calibrator": {
        "class": "RecCalibrator",
        "nmodes": MODES,
        "rec_tag": "rec",
        "overwrite": True,
        "inputs": {"in_intmat": "im_calibrator.out_intmat"},
    },
    "remove": ["atmo", "rec", "control", "psf"],
}


def run(*tables: dict[str, Any]) -> Simul:
    """Run SPECULA on parameter files of these tables."""
    paths = []
    for number, table in enumerate(tables):
        path = FOLDER / f"{number}.yml"
        path.write_text(yaml.safe_dump(table))
        paths.append(str(path))
    simulation = Simul(*paths, speed_report=False, log_level="error")
    simulation.run()
    return simulation


class Setup:
    """A slope computer: SPECULA's own with options, or faintspot's with its tables."""

    def __init__(self, label: str, own: dict[str, Any] | None = None, **tables: Any) -> None:
        self.label = label
        self.keys: dict[str, Any] = {} if own is None else own
        self.calibrating: dict[str, Any] = {}
        self.tag = "rec_" + "".join(c if c.isalnum() else "_" for c in f"{label}_{sorted(tables)}_{own}")
        if own is None:
            camera = {"dark": 0.0, "read_noise_e": 1.0}
            psf = {"profile": "diffraction", "size": 0.65e-6 / 0.6 * 206265 / 0.11 / 2}
            faintspot = {"calibration": camera, "psf": psf, **tables}
            self.keys = {"class": "FaintspotSlopec", "faintspot": faintspot}
            self.calibrating = {"calibrating": True}
        self.ready = False

    def __repr__(self) -> str:
        return self.label

    def calibrate(self) -> None:
        """Make its reconstructor."""
        interaction = {**INTERACTION, "slopec_override": {**self.keys, **self.calibrating}}
        interaction["rec_calibrator"] = {**INTERACTION["rec_calibrator"], "rec_tag": self.tag}
        run(SYSTEM, interaction)
        self.ready = True


def strehl(setup: Setup, gain: float, seed: int) -> float:
    """Close the loop and return the long-exposure Strehl ratio at 1.65 um."""
    if not setup.ready:
        setup.calibrate()
    loop = {
        "atmo_override": {"seed": seed},
        "detector_override": {"photon_seed": seed + 1000, "readout_seed": seed + 2000},
        "slopec_override": setup.keys,
        "rec_override": {"recmat_object": setup.tag},
        "control_override": {"int_gain": [gain] * MODES},
    }
    return float(np.ravel(run(SYSTEM, loop).objs["psf"].outputs["out_int_sr"].value)[0])


def table(name: str, **options: Any) -> dict[str, Any]:
    """Return faintspot's tables of an estimator."""
    return {"estimator": {"name": name, **options}, "settings": {"flux_e": FLUX_E}}


METHODS = {
    "SPECULA, weighted": [Setup(f"{2 * r:g} px", {"weightedPixRad": r}) for r in (2.0, 3.0)],
    "SPECULA, threshold": [Setup(f"{t:g} e-", {"thr_value": t}) for t in (1.0, 2.0)],
    "faintspot, brightest pixels": [
        Setup(f"{k} pixels", **table("brightest", keep_brightest=k)) for k in (10, 20)
    ],
    "faintspot, window": [Setup(f"{w:g} px", **table("window", window_fwhm_px=w)) for w in (4.0, 6.0)],
    "faintspot, smoothed": [Setup(f"{k} pixels", **table("smoothed", keep_brightest=k)) for k in (10, 20)],
    "faintspot, TV": [
        Setup(f"{s:g}, 15 pixels", **table("tv", noise_std=s, keep_brightest=15)) for s in (0.3, 0.6)
    ],
    "faintspot, map": [
        Setup(f"prior {p:g} px", **table("map", prior_std_px=p, blur_px=0.8)) for p in (0.4, 0.8)
    ],
}


if __name__ == "__main__":
    run(SYSTEM, SUBAPERTURES)
    print(f"about {FLUX_E:g} e- a lenslet, 1 e- read noise; Strehl ratio at 1.65 um")
    compare(METHODS, strehl, GAINS, tuning=(1,), every_k=(11, 12, 13))
