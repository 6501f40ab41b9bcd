"""faintspot in an HCIPy closed loop: its estimator in place of HCIPy's own, for a faint star.

A 4.2 m telescope, 7x7 lenslets of 12x12 pixels, 40 photons per lenslet and frame, 250 frames/s, 1 electron of
read noise. For a fair comparison every estimator sees the same air, with noise from the same seed, has an
interaction matrix of its own without noise, and the loop gain and numbers of its own (level, kept
pixels, strength) that served it best on other air than it is then judged by.
"""

from contextlib import nullcontext
from functools import cache
from typing import Any

import hcipy
import numpy as np

import faintspot as fs
from faintspot.adapters.hcipy import SlopeEstimator

FLUX_E, READ_NOISE_E, FRAMES, SETTLE = 40.0, 1.0, 250, 50
GAINS = (0.1, 0.2, 0.35, 0.5, 0.7)
SENSING_M, IMAGING_M, DIAMETER_M, RATE_HZ = 0.65e-6, 1.65e-6, 4.2, 250.0

# The user's own system, all of it HCIPy's.
grid = hcipy.make_pupil_grid(84, DIAMETER_M)
pupil = hcipy.evaluate_supersampled(hcipy.make_obstructed_circular_aperture(DIAMETER_M, 0.285), grid, 4)
mirror = hcipy.DeformableMirror(hcipy.make_gaussian_influence_functions(grid, 8, DIAMETER_M / 7))
shrink = hcipy.Magnifier(1e-3)
sensor = hcipy.SquareShackHartmannWavefrontSensorOptics(grid.scaled(1e-3), 154, 7, 1e-3 * DIAMETER_M)
noiseless = hcipy.NoiselessDetector(grid.scaled(1e-3))
noisy = hcipy.NoisyDetector(grid.scaled(1e-3), read_noise=READ_NOISE_E)


def image(detector: hcipy.Detector, path_m: np.ndarray, photons: float) -> hcipy.Field:
    """Return what a detector sees of an optical path difference, after the mirror."""
    wavefront = hcipy.Wavefront(pupil * np.exp(2j * np.pi / SENSING_M * path_m), SENSING_M)
    wavefront.total_power = photons
    return detector(sensor(shrink(mirror(wavefront))))


flat = image(noiseless, 0 * pupil, 1.0)
flux = np.bincount(sensor.mla_index, flat, sensor.mla_grid.size)
illuminated = flux > 0.5 * flux.max()
photons = FLUX_E / flux[illuminated].mean()


@cache
def screens(seed: int) -> list[np.ndarray]:
    """Return the air's path difference, m, in every frame."""
    strength = hcipy.Cn_squared_from_fried_parameter(0.15, 500e-9)
    layer = hcipy.InfiniteAtmosphericLayer(grid, strength, 25.0, 10.0, seed=seed)
    paths = []
    for frame in range(FRAMES):
        layer.t = frame / RATE_HZ
        paths.append(layer.phase_for(SENSING_M) * SENSING_M / (2 * np.pi))
    return paths


def calibrate(estimator: hcipy.WavefrontSensorEstimator) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of a flat wavefront and the control matrix, without noise."""
    slopes, calibrating = [], getattr(estimator, "calibrating", nullcontext)
    with calibrating():
        for poke_m in 3e-8 * np.vstack([np.eye(mirror.num_actuators), -np.eye(mirror.num_actuators)]):
            mirror.actuators = poke_m
            slopes.append(np.asarray(estimator.estimate([image(noiseless, 0 * pupil, photons)])).ravel())
    plus, minus = np.split(np.array(slopes), 2)
    return np.mean(slopes, axis=0), hcipy.inverse_tikhonov((plus - minus).T / 6e-8, rcond=0.03)


def strehl(
    estimator: hcipy.WavefrontSensorEstimator, control: tuple[Any, Any], gain: float, seed: int
) -> float:
    """Close the loop and return the long-exposure Strehl ratio."""
    reference, matrix = control
    mirror.flatten()
    np.random.seed(seed)  # noqa: NPY002 - HCIPy's detectors draw from this one
    ratios = []
    for path_m in screens(seed):
        residual = path_m + mirror.opd
        ratios.append(np.abs(np.average(np.exp(2j * np.pi / IMAGING_M * residual), weights=pupil)) ** 2)
        slopes = np.asarray(estimator.estimate([image(noisy, path_m, photons)])).ravel()
        mirror.actuators = mirror.actuators - gain * matrix @ (slopes - reference)
    return float(np.mean(ratios[SETTLE:]))


class Thresholded(hcipy.ShackHartmannWavefrontSensorEstimator):  # type: ignore[misc]
    """HCIPy's estimator, after what many do first: take a level off the image."""

    def __init__(self, level_e: float) -> None:
        super().__init__(sensor.mla_grid, sensor.mla_index, illuminated)
        self.level_e = level_e

    def estimate(self, images: list[hcipy.Field]) -> hcipy.Field:
        """Measure what is above the level."""
        return super().estimate([np.maximum(images[0] - self.level_e, 1e-9)])


def ours(**settings: Any) -> SlopeEstimator:
    """Return faintspot's estimator: the same arguments as HCIPy's, and settings."""
    return SlopeEstimator(sensor.mla_grid, sensor.mla_index, illuminated, settings=fs.Settings(**settings))


METHODS = {
    "HCIPy, centre of gravity": [
        hcipy.ShackHartmannWavefrontSensorEstimator(sensor.mla_grid, sensor.mla_index, illuminated)
    ],
    "HCIPy, thresholded": [Thresholded(level) for level in (1.0, 2.0, 3.0)],
    "faintspot, brightest pixels": [ours(estimator="brightest", keep_brightest=k) for k in (20, 40)],
    "faintspot, smoothed": [ours(estimator="smoothed", keep_brightest=k) for k in (20, 40)],
    "faintspot, TV": [ours(noise_std=s, keep_brightest=k) for s in (0.3, 0.6, 0.9) for k in (20, 40)],
}


def main() -> None:
    """Tune every method on two pieces of air, then judge it on three others."""
    print(f"{FLUX_E:g} photons a lenslet, {READ_NOISE_E:g} e- read noise; Strehl ratio at 1.65 um")
    for name, estimators in METHODS.items():
        tried = []
        for estimator in estimators:
            control = calibrate(estimator)
            for gain in GAINS:
                tuning = [strehl(estimator, control, gain, seed) for seed in (1, 5)]
                tried.append((np.mean(tuning), gain, estimator, control))
        _, gain, estimator, control = max(tried, key=lambda t: t[0])
        scores = [strehl(estimator, control, gain, seed) for seed in (12, 13, 14)]
        print(f"{name:27s} {np.mean(scores):.3f} (air by air {np.round(scores, 3)}, loop gain {gain:g})")


if __name__ == "__main__":
    main()
