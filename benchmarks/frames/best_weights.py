"""By how much the best linear weights beat a fixed Gaussian window, on spots as a closed loop leaves them.

Sub-apertures of 1.14 r0 (near the diffraction limit) and 2.92 r0 (speckled), lambda / d = 2 px, 16 x 16 px,
3 e- of read noise, the mean light known; positions are normal with the given rms. Widths of the window, and
gains, are chosen on other spots than the scored ones, and the weights are made from still others. Rms error
per axis after the gain is taken off; standard errors by blocks of spots, paired for the ratio.

    python -m benchmarks.frames.best_weights [--motion 0.5] [--spots 20000]
"""

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.pipeline.images import measure_images

SIDE, READ_NOISE_E, FWHM_PX, BLOCKS = 16, 3.0, 1.772, 40
SPOTS = {"near the diffraction limit": 1.14, "speckled": 2.92}
FLUX_E = (20.0, 60.0, 200.0)
WIDTHS = (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0)  # of the window, in units of the spot's

Floats = NDArray[np.float64]


def residual_spots(n: int, d_over_r0: float, motion_px: float, seed: int) -> tuple[Floats, Floats]:
    """Return images without noise, of unit light, and their positions."""
    rng = np.random.default_rng([seed, int(100 * d_over_r0)])
    positions = rng.normal(0.0, motion_px, (n, 2))
    images, truth = fs.slopes.simulate.speckled_spots(
        n, d_over_r0=d_over_r0, shape=(SIDE, SIDE), positions=positions, rng=rng
    )
    return images, truth


def slopes_of(images: Floats, flux_e: float, seed: int, options: dict[str, Any], weights: Any) -> Floats:
    """Return slopes (n, 2) of noisy images."""
    noisy = fs.slopes.simulate.Detector(READ_NOISE_E).expose(flux_e * images, np.random.default_rng(seed))
    settings = fs.Settings(Window(**options), spot_fwhm_px=FWHM_PX, flux_e=flux_e * images.sum((1, 2)).mean())
    found = measure_images(
        noisy, settings, calibration=fs.Calibration(read_noise_e=READ_NOISE_E), weights=weights
    )
    return np.stack([found.x, found.y], axis=1).astype(np.float64)


def main(motion_px: float, n: int) -> None:
    """Print a table."""
    print("| spots | light, e- | window of best width: FWHM, px | its rms, px | best weights, px | less |")
    print("|---|---|---|---|---|---|")
    for name, d_over_r0 in SPOTS.items():
        learnt, tuned, scored = (residual_spots(n, d_over_r0, motion_px, seed) for seed in (1, 2, 3))
        for flux_e in FLUX_E:
            best = fs.FixedWeights.best_linear(*learnt, flux_e=flux_e, read_noise_e=READ_NOISE_E)
            methods: list[tuple[dict[str, Any], Any]] = [
                ({"window_fwhm_px": width * FWHM_PX}, None) for width in WIDTHS
            ]
            methods.append(({}, best))
            gains, errors = [], []
            for options, weights in methods:
                slopes = slopes_of(tuned[0], flux_e, 4, options, weights)
                gains.append(float((slopes * tuned[1]).sum() / (tuned[1] ** 2).sum()))
                errors.append(np.mean((slopes / gains[-1] - tuned[1]) ** 2))
            chosen = int(np.argmin(errors[:-1]))
            squares = []
            for i in (chosen, -1):
                slopes = slopes_of(scored[0], flux_e, 5, *methods[i]) / gains[i]
                squares.append(((slopes - scored[1]) ** 2).mean(axis=1).reshape(BLOCKS, -1).mean(axis=1))
            rms, ratio = np.sqrt([s.mean() for s in squares]), np.sqrt(squares[1].mean() / squares[0].mean())
            scatter = [s.std() / 2 / s.mean() / np.sqrt(BLOCKS) for s in squares]
            paired = (squares[1] / squares[1].mean() - squares[0] / squares[0].mean()).std() / 2
            edge = " (end of the grid)" if chosen in (0, len(WIDTHS) - 1) else ""
            print(
                f"| {name} | {flux_e:g} | {WIDTHS[chosen] * FWHM_PX:.2f}{edge} "
                f"| {rms[0]:.4f} ± {rms[0] * scatter[0]:.4f} | {rms[1]:.4f} ± {rms[1] * scatter[1]:.4f} "
                f"| {100 * (1 - ratio):.1f} ± {100 * ratio * paired / np.sqrt(BLOCKS):.1f} % |",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--motion", type=float, default=0.5, help="Rms position per axis, px (0.5).")
    parser.add_argument("--spots", type=int, default=20_000, help="Of each sample (20000).")
    arguments = parser.parse_args()
    main(arguments.motion, arguments.spots)
