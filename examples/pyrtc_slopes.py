"""faintspot as pyRTC's slopes process, beside pyRTC's own centroiders, for a faint star.

pyRTC's slopes process and pyRTC's loop, frame by frame; camera, air and mirror are simulated: 6x6 lenslets of
10x10 pixels, 40 electrons per lenslet and frame, 1 electron of read noise. The mirror makes the 14 modes that
the air is made of. In the configuration `class_name` changes, and `faintspot` says how to measure. Every
method has an interaction matrix of its own and is tuned on other air than it is judged by. What is scored:
the part of the air's displacements of the spots that is taken off.
"""

import contextlib
import logging
from functools import cache
from typing import Any
from uuid import uuid4

import numpy as np
from loop_table import compare

logging.disable(logging.INFO)

from pyrtc import Loop, SlopesProcess, clear_shms, create_stream  # noqa: E402 - says much

import faintspot as fs  # noqa: E402
from faintspot.adapters.pyrtc import FaintspotSlopes  # noqa: E402

GRID, SIDE, FLUX_E, READ_NOISE_E, FRAMES, SETTLE = 6, 10, 40.0, 1.0, 300, 50
GAINS = (0.1, 0.2, 0.3, 0.45, 0.6)
PSF = fs.PSF.analytic("diffraction", size=1.0)  # lambda / d of 2 px
LAYOUT = fs.Layout.grid((GRID, GRID), pixels=SIDE)


def gradients() -> np.ndarray:
    """Return the spots' displacements by polynomials of order 1 to 4, orthonormal: (2 n, modes)."""
    y, x = (2 * np.indices((GRID, GRID)).reshape(2, -1) + 1) / GRID - 1
    modes = []
    for order in range(1, 5):
        for a in range(order + 1):
            b = order - a
            modes.append(np.concatenate([a * x ** max(a - 1, 0) * y**b, b * x**a * y ** max(b - 1, 0)]))
    return np.linalg.qr(np.array(modes).T)[0] * np.sqrt(2 * GRID**2)


MODES = gradients()
ORDERS = np.repeat(np.arange(1, 5), np.arange(2, 6))


@cache
def atmosphere(seed: int) -> np.ndarray:
    """Return the modes' coefficients, px, in every frame: slower and larger where the order is low."""
    rng = np.random.default_rng(seed)
    keep = 1.0 - 0.01 * ORDERS
    now, frames = rng.normal(size=len(ORDERS)), []
    for _ in range(FRAMES):
        frames.append(now)
        now = keep * now + np.sqrt(1 - keep**2) * rng.normal(size=len(ORDERS))
    return 0.8 / ORDERS * np.array(frames)


def image(displacements: np.ndarray, flux_e: float = FLUX_E, rng: Any = None) -> np.ndarray:
    """Return a frame of spots that are displaced (2 n,) px; without noise where there is no `rng`."""
    spots = np.maximum(PSF.images(displacements.reshape(2, -1).T, (SIDE, SIDE), flux_e), 0.0)
    frame = spots.reshape(GRID, GRID, SIDE, SIDE).transpose(0, 2, 1, 3).reshape(GRID * SIDE, -1)
    if rng is not None:
        frame = rng.poisson(frame) + rng.normal(0.0, READ_NOISE_E, frame.shape)
    return np.ascontiguousarray(frame, np.float32)


class Setup:
    """A slopes process, pyRTC's own or faintspot's, and its loop."""

    def __init__(self, label: str, own: dict[str, Any] | None = None, **tables: Any) -> None:
        self.label = label
        if own is None:
            camera = {"dark": 0.0, "read_noise_e": READ_NOISE_E}
            psf = {"profile": "diffraction", "size": 1.0}
            self.kind, keys = FaintspotSlopes, {"faintspot": {"calibration": camera, "psf": psf, **tables}}
        else:
            self.kind, keys = SlopesProcess, own
        self.configuration = {
            "type": "SHWFS",
            "signal_type": "slopes",
            "sub_ap_spacing": SIDE,
            "sub_ap_offset_x": 0,
            "sub_ap_offset_y": 0,
            "image_noise": READ_NOISE_E,
            "functions": [],
            **keys,
        }
        self.matrix: np.ndarray | None = None

    def __repr__(self) -> str:
        return self.label

    def interaction(self, camera: Any, slopes: Any) -> np.ndarray:
        """Return the signals of each mode, from frames without noise."""

        def signal(coefficients: np.ndarray) -> np.ndarray:
            camera.write(image(MODES @ coefficients))
            slopes.compute_signal()
            return np.array(slopes.read(block=False))

        calibrating = getattr(slopes, "calibrating", contextlib.nullcontext)
        signal(np.zeros(len(ORDERS)))  # makes the pipeline
        with calibrating():
            pokes = 0.1 * np.eye(len(ORDERS))
            return np.array([(signal(poke) - signal(-poke)) / 0.2 for poke in pokes]).T


def part_taken_off(setup: Setup, gain: float, seed: int) -> float:
    """Close the loop and return 1 - variance of the displacements that are left over the air's."""
    name = f"faintspot_{uuid4().hex[:8]}"
    streams = {stream: f"{name}_{stream}" for stream in ("wfs", "signal", "signal_2d", "wfc")}
    outputs = {stream: streams[stream] for stream in ("signal", "signal_2d")}
    camera = create_stream(streams["wfs"], (GRID * SIDE, GRID * SIDE), np.float32)
    commands = create_stream(streams["wfc"], (len(ORDERS),), np.float32)
    commands.write(np.zeros(len(ORDERS), np.float32))
    slopes = loop = None
    try:
        slopes = setup.kind(
            {**setup.configuration, "input_streams": {"wfs": streams["wfs"]}, "output_streams": outputs}
        )
        if setup.matrix is None:
            setup.matrix = setup.interaction(camera, slopes)
        loop = Loop(
            {
                "gain": gain,
                "functions": [],
                "input_streams": {"signal": streams["signal"]},
                "output_streams": {"wfc": streams["wfc"]},
            }
        )
        loop.im = setup.matrix.astype(np.float32)
        loop.compute_cm()
        rng, left = np.random.default_rng(seed + 1000), []
        for coefficients in atmosphere(seed):
            residual = MODES @ (coefficients + np.ravel(commands.read()))
            left.append(residual)
            camera.write(image(residual, rng=rng))
            slopes.compute_signal()
            loop.standard_integrator()
    finally:
        for component in (slopes, loop):
            if component is not None:
                component.close()
        clear_shms(streams.values())
    return float(1.0 - np.var(left[SETTLE:]) / np.var(atmosphere(seed)[SETTLE:] @ MODES.T))


def table(name: str, **options: Any) -> dict[str, Any]:
    """Return faintspot's tables of an estimator."""
    return {"estimator": {"name": name, **options}, "settings": {"flux_e": FLUX_E}}


METHODS = {
    "pyRTC, weighted": [Setup(f"{w:g} px", {"centroider": "wcog", "wcog_fwhm": w}) for w in (2.0, 3.0, 4.0)],
    "pyRTC, threshold": [Setup(f"{c:g} e-", {"contrast": c}) for c in (1.0, 2.0, 3.0)],
    "faintspot, brightest pixels": [
        Setup(f"{k} pixels", **table("brightest", keep_brightest=k)) for k in (6, 10, 15)
    ],
    "faintspot, window": [Setup(f"{w:g} px", **table("window", window_fwhm_px=w)) for w in (2.0, 3.0, 4.0)],
    "faintspot, smoothed": [Setup(f"{k} pixels", **table("smoothed", keep_brightest=k)) for k in (6, 10, 15)],
    "faintspot, TV": [
        Setup(f"{s:g}, 10 pixels", **table("tv", noise_std=s, keep_brightest=10)) for s in (0.3, 0.6)
    ],
    "faintspot, map": [Setup(f"prior {p:g} px", **table("map", prior_std_px=p)) for p in (0.3, 0.6)],
}


if __name__ == "__main__":
    print(f"{FLUX_E:g} e- a lenslet, {READ_NOISE_E:g} e- read noise; part of the variance that is taken off")
    compare(METHODS, part_taken_off, GAINS, score="part taken off")
