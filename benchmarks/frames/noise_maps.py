"""What does one number for the read noise cost, of a CMOS camera whose pixels differ?

Prints Markdown tables of the photon efficiency of estimators that know one number (the root mean square of
the pixels) or the map of the read noise, against the Cramer-Rao bound of a camera whose noise is known for
each pixel, and of the ratio of slope errors to standard errors. Errors: jackknife over frames.

    python -m benchmarks.frames.noise_maps
"""

import argparse
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.spots.bounds import MEAN_ABSOLUTE

SIDE = 8
LENSLETS = 10  # along a side of the frame
LAYOUT = fs.Layout.grid((LENSLETS, LENSLETS), pixels=SIDE)
RANGE_PX = 0.5  # of the spots' positions
PSF = fs.PSF.analytic("gaussian")
FLUXES = {0.3: (10, 20, 40, 100), 1.0: (20, 40, 80, 200), 2.0: (40, 80, 160, 400)}
STEP = 0.1  # of the logarithm of the noise: the exact bound needs a table for each value
OFFSET_ADU = 100.0
TRAINING = 4000  # spots of the best linear weights
PARTS = 20  # of the frames, for standard errors
METHODS = ("weighted", "window", "best linear", "ml", "map")

Floats = NDArray[np.float64]


class Scored(NamedTuple):
    """Slope errors of one estimator."""

    efficiency: float
    efficiency_error: float
    ratios: Floats
    """Rms of the errors over the standard errors in each sub-aperture."""


def camera(median_e: float, spread: float, blinking: float, seed: int) -> fs.slopes.simulate.Detector:
    """Return a camera whose read noise has few different values."""
    drawn = fs.slopes.simulate.Detector.cmos(
        LAYOUT.frame_shape,
        median_e,
        spread=spread,
        blinking_fraction=blinking,
        blinking_e=10.0 * median_e,
        offset_adu=OFFSET_ADU,
        rng=np.random.default_rng(seed),
    )
    levels = np.rint(np.log(drawn.read_noise_e / median_e) / STEP)
    return replace(drawn, read_noise_e=median_e * np.exp(STEP * levels))


def frames_of(detector: fs.slopes.simulate.Detector, flux: float, n: int, seed: int) -> tuple[Any, Floats]:
    """Return frames and the positions of their spots (n, sub-apertures, 2)."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-RANGE_PX, RANGE_PX, (n, len(LAYOUT), 2))
    mean = np.maximum(PSF.images(truth.reshape(-1, 2), (SIDE, SIDE), flux), 0.0)
    tiles = mean.reshape(n, LENSLETS, LENSLETS, SIDE, SIDE).swapaxes(2, 3)
    return detector.expose(tiles.reshape(n, *LAYOUT.frame_shape), rng), truth


def bounds_px(noise: Floats, fluxes: Floats) -> Floats:
    """Return the bound of the slope error, the mean of the sub-apertures, for each flux."""
    known: dict[str, Any] = {"shape": (SIDE, SIDE), "psf": PSF, "position_range_px": RANGE_PX}
    windows = [fs.slopes.simulate.Detector(own) for own in LAYOUT.images(noise)]
    each = [fs.cramer_rao(fluxes, detector=window, **known) for window in windows]
    return np.asarray(MEAN_ABSOLUTE * np.mean(each, axis=(0, 2)))


def weights(noise: Any, flux: float) -> fs.FixedWeights:
    """Return the best linear weights of each sub-aperture."""
    places = np.random.default_rng(9).uniform(-RANGE_PX, RANGE_PX, (TRAINING, 2))
    clean = PSF.images(places, (SIDE, SIDE))
    windows = LAYOUT.images(noise) if np.ndim(noise) else [noise]
    found = [fs.FixedWeights.best_linear(clean, places, flux_e=flux, read_noise_e=own) for own in windows]
    x, y, spot, weight = (
        np.concatenate([getattr(each, name) for each in found]) for name in ("x", "y", "mean_spot", "flux")
    )
    return fs.FixedWeights(x, y, spot, weight, np.arange(len(LAYOUT)) % len(found))


def scored(
    method: str,
    calibration: fs.Calibration,
    frames: Any,
    truth: Floats,
    flux: float,
    bounds: tuple[Floats, Floats],
) -> Scored:
    """Measure the frames with a method."""
    name = "window" if method == "best linear" else method
    score = weights(calibration.read_noise_e, flux) if method == "best linear" else None
    settings = fs.Settings(name, flux_e=flux, search_range_px=1.5)
    slopes = fs.SlopePipeline(LAYOUT, settings, calibration, psf=PSF, weights=score)(frames)
    errors = np.stack([slopes.x, slopes.y], axis=-1) - truth
    stated = np.stack([slopes.standard_error_x, slopes.standard_error_y], axis=-1)
    ratios = np.sqrt(np.mean(np.square(errors / stated), axis=(0, 2)))
    each = np.array_split(np.abs(errors).mean(axis=(1, 2)), PARTS)

    def efficiency(parts: list[Floats]) -> float:
        error = float(np.concatenate(parts).mean())
        return float(np.exp(np.interp(-np.log(error), -np.log(bounds[1]), np.log(bounds[0])))) / flux

    without = [efficiency(each[:k] + each[k + 1 :]) for k in range(PARTS)]
    return Scored(efficiency(each), float(np.sqrt((PARTS - 1) * np.var(without))), ratios)


def table(median_e: float, spread: float, n: int) -> None:
    """Print what the number and the map give."""
    detector = camera(median_e, spread, 0.0, seed=1)
    noise = np.asarray(detector.read_noise_e)
    rms = float(np.sqrt(np.mean(np.square(noise))))
    fluxes = np.geomspace(0.1 * min(FLUXES[median_e]), 2.0 * max(FLUXES[median_e]), 16)
    bounds = fluxes, bounds_px(noise, fluxes)
    samples = {flux: frames_of(detector, flux, n, seed=2) for flux in FLUXES[median_e]}
    print(f"\nMedian {median_e:g} e-, rms {rms:.2f} e- (spread {spread:g})\n")
    for flux in samples:
        print(f"bound at {flux} e-: {np.interp(flux, *bounds):.3f} px")
    print("\n| method | " + " | ".join(f"{flux} e-, number | {flux} e-, map" for flux in samples) + " |")
    print("|---" * (1 + 2 * len(samples)) + "|")
    ratios = []
    for method in METHODS:
        cells, spans = [method], [method]
        for flux, (frames, truth) in samples.items():
            for known in (rms, noise):
                calibration = fs.Calibration(OFFSET_ADU, read_noise_e=known)
                found = scored(method, calibration, frames, truth, flux, bounds)
                cells.append(f"{found.efficiency:.3f} ± {found.efficiency_error:.3f}")
                low, high = np.quantile(found.ratios, (0.05, 0.95))
                spans.append(f"{low:.2f} to {high:.2f}")
        print("| " + " | ".join(cells) + " |", flush=True)
        ratios.append(spans)
    print("\nErrors over standard errors, 5 to 95 % of the sub-apertures\n")
    for spans in ratios:
        print("| " + " | ".join(spans) + " |")


def numbers_table(median_e: float, spread: float, n: int) -> None:
    """Print what `ml` gains over two numbers, and its efficiency with a camera whose pixels are equal."""
    detector = camera(median_e, spread, 0.0, seed=1)
    noise = np.asarray(detector.read_noise_e)
    rms = float(np.sqrt(np.mean(np.square(noise))))
    equal = replace(detector, read_noise_e=np.full(LAYOUT.frame_shape, median_e))
    print(f"\nMedian {median_e:g} e- (spread {spread:g}), ml: median, rms, map; pixels of {median_e:g} e-\n")
    for flux in FLUXES[median_e][:3]:
        fluxes = np.geomspace(0.05 * flux, 4.0 * flux, 16)
        cells = [f"{flux} e-"]
        for own, numbers in ((detector, (median_e, rms, noise)), (equal, (median_e,))):
            bounds = fluxes, bounds_px(np.asarray(own.read_noise_e), fluxes)
            frames, truth = frames_of(own, flux, n, seed=2)
            for known in numbers:
                calibration = fs.Calibration(OFFSET_ADU, read_noise_e=known)
                found = scored("ml", calibration, frames, truth, flux, bounds)
                cells.append(f"{found.efficiency:.3f} ± {found.efficiency_error:.3f}")
        print("| " + " | ".join(cells) + " |", flush=True)


def blinking_table(median_e: float, n: int) -> None:
    """Print what a measured map gives, and bad pixels, of a camera in which 1 % of the pixels blink."""
    detector = camera(median_e, 0.5, 0.01, seed=3)
    darks = detector.expose(np.zeros((60, *LAYOUT.frame_shape)), np.random.default_rng(4))
    pixels = fs.measure_detector(darks=darks).pixels
    assert pixels is not None
    true = np.sqrt(detector.variance(np.zeros(LAYOUT.frame_shape)))
    rms = float(np.sqrt(np.mean(np.square(true))))
    ways: dict[str, dict[str, Any]] = {
        "number": {"dark": OFFSET_ADU, "read_noise_e": rms},
        "true map": {"dark": OFFSET_ADU, "read_noise_e": true},
        "measured dark and map": {"dark": pixels.level_adu, "read_noise_e": pixels.noise_adu},
    }
    ways["the same, blinking pixels bad"] = {**ways["measured dark and map"], "bad_pixels": pixels.blinking}
    ways["number, blinking pixels bad"] = {**ways["number"], "bad_pixels": pixels.blinking}
    flux = FLUXES[median_e][1]
    fluxes = np.geomspace(0.05 * flux, 4.0 * flux, 16)
    bounds = fluxes, bounds_px(np.asarray(detector.read_noise_e), fluxes)
    frames, truth = frames_of(detector, flux, n, seed=5)
    count = len(detector.blinking_pixels), len(pixels.blinking)
    print(f"\nMedian {median_e:g} e-, {flux} e-, {count[0]} pixels blink, {count[1]} found\n")
    for name, values in ways.items():
        cells = [name]
        for method in ("weighted", "window", "ml"):
            found = scored(method, fs.Calibration(**values), frames, truth, flux, bounds)
            cells.append(f"{found.efficiency:.3f} ± {found.efficiency_error:.3f}")
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description="Measure what one number for the read noise costs.")
    parser.add_argument("--frames", type=int, default=200, help="Frames of 100 spots. [default: 200]")
    parser.add_argument("--medians", type=float, nargs="*", default=list(FLUXES), help="Read noises [e-].")
    chosen = parser.parse_args()
    for median_e in chosen.medians:
        for spread in (0.5, 0.7):
            table(median_e, spread, chosen.frames)
            numbers_table(median_e, spread, chosen.frames)
        blinking_table(median_e, chosen.frames)


if __name__ == "__main__":
    main()
