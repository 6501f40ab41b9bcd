"""Configurations of the tests of the loop: the default telescope, with air that does not change."""

from __future__ import annotations

import numpy as np

import faintspot as fs
from faintspot.loop.simulation import LoopConfiguration, Method
from faintspot.loop.simulation.configuration.sections import Camera

PLAIN = fs.Settings("brightest", keep_brightest=80)


def quiet() -> LoopConfiguration:
    """Plenty of flux and no read noise."""
    return LoopConfiguration(camera=Camera(photons_per_subaperture=1e6, read_noise_e=0.0)).replace(
        "run", frames=200, settle_frames=40
    )


def faint() -> LoopConfiguration:
    """200 photons and 1 electron of read noise."""
    return quiet().replace("camera", photons_per_subaperture=200.0, read_noise_e=1.0)


def plain(label: str = "plain") -> Method:
    """Brightest pixels and centre of gravity."""
    return Method(label, PLAIN)


def expected_variance(amplitude: np.ndarray, spacing_m: float, r0_m: float, outer_scale_m: float) -> float:
    """Return the variance over a pupil without piston, rad^2, of von Karman turbulence.

    Half the mean of the structure function (Conan 2008, JOSA A 25, 526) over all pairs of points.
    """
    import hcipy

    n = len(amplitude)
    spectrum = np.abs(np.fft.fft2(amplitude / amplitude.sum(), (2 * n, 2 * n))) ** 2
    pairs = np.fft.ifft2(spectrum).real  # weight of each separation
    lag = np.fft.fftfreq(2 * n, 1 / (2 * n)) * spacing_m
    distance = np.maximum(np.hypot(lag[:, None], lag), 1e-6).ravel()
    grid = hcipy.CartesianGrid(hcipy.UnstructuredCoords((distance, np.zeros_like(distance))))
    structure = np.array(hcipy.phase_structure_function_von_karman(r0_m, outer_scale_m)(grid))
    return float(0.5 * (pairs.ravel() * structure).sum())
