"""How well are real spots measured at low light? Thin the electrons of bright frames, and compare.

Takes bright frames of a static field, bins them, thins their electrons to a given flux per sub-aperture
(each electron survives with the same probability, which keeps Poisson statistics), adds read noise, and
prints the slope error R of brightest pixels with and without TV denoising. Every frame is moved by up to 2
unbinned pixels along each axis before binning: in a static field an estimator that always answers "no light,
reference position" would win. The truth is the mean of all frames, moved alike and measured with the same
number of kept pixels and without denoising. Number of kept pixels and strength are chosen on one half of the
frames and scored on the other.

    python -m benchmarks.frames.thinned_spots bench.npz --gain-e-per-adu 2.1
"""

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.base.statistics import absolute_errors
from faintspot.io import open_frames
from faintspot.slopes.estimators.noise import suggested_strength

KEPT = (6, 8, 10, 12, 16, 20, 25, 30, 40, 50, 60, 80)
FIXED = 40
STRENGTH_FACTORS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
FLUXES_E = (1000, 300, 200, 100, 30)


def binned(frames: NDArray[Any], factor: int) -> NDArray[np.float64]:
    """Sum squares of factor x factor pixels; rows and columns that do not fill one are left out."""
    n, h, w = frames.shape
    h, w = h // factor * factor, w // factor * factor
    cut = frames[:, :h, :w].astype(np.float64)
    return np.asarray(cut.reshape(n, h // factor, factor, w // factor, factor).sum(axis=(2, 4)))


def moved(image: NDArray[Any], dy: int, dx: int) -> NDArray[Any]:
    """Shift images by whole pixels; what enters at an edge is what left at the other."""
    return np.roll(image, (dy, dx), axis=(-2, -1))


def errors(
    layout: fs.Layout, settings: fs.Settings, frames: list[NDArray[Any]], bright: list[NDArray[Any]]
) -> Any:
    """Errors of all slopes of the frames of every shift, against the bright frame of the same shift."""
    plain = fs.SlopePipeline(layout, settings.replace(estimator="brightest"))
    pipeline = fs.SlopePipeline(layout, settings)
    parts = []
    for stack, mean in zip(frames, bright, strict=True):
        truth, slopes = plain(mean), pipeline(stack)
        shape = slopes.x.shape
        truth_xy = np.stack([np.broadcast_to(truth.x, shape), np.broadcast_to(truth.y, shape)], axis=-1)
        parts.append(absolute_errors(slopes.x, slopes.y, truth_xy).ravel())
    return np.concatenate(parts)


def best(
    candidates: list[fs.Settings], layout: fs.Layout, frames: list[NDArray[Any]], bright: list[NDArray[Any]]
) -> tuple[fs.Settings, NDArray[np.float64]]:
    """Choose on one half of the frames, return the errors of the other."""
    first, second = [stack[::2] for stack in frames], [stack[1::2] for stack in frames]
    chosen = min(candidates, key=lambda settings: float(errors(layout, settings, first, bright).mean()))
    return chosen, errors(layout, chosen, second, bright)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("frames", nargs="+")
    parser.add_argument("--gain-e-per-adu", dest="gain", type=float, default=1.0, help="electrons per ADU")
    parser.add_argument("--dark", type=float, help="ADU; default: 1st percentile of the mean frame")
    parser.add_argument("--bin", type=int, default=2)
    parser.add_argument(
        "--read-noise-e", dest="read_noise", type=float, nargs="+", default=[0.1, 3.0], help="electrons"
    )
    arguments = parser.parse_args()
    with open_frames(arguments.frames) as source:
        raw = source.block(0, source.n_frames).astype(np.float64)
    dark = np.percentile(raw.mean(axis=0), 1) if arguments.dark is None else arguments.dark
    electrons = np.maximum((raw - dark) * arguments.gain, 0)
    layout = fs.Layout.from_frame(binned(electrons, arguments.bin).mean(axis=0), move_windows=False)
    shifts = [(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3)]
    full = [binned(moved(electrons, *shift), arguments.bin) for shift in shifts]
    bright = [stack.mean(axis=0) for stack in full]
    total = float(layout.images(bright[len(bright) // 2]).sum(axis=(1, 2)).mean())
    print(f"{len(layout)} sub-apertures of {layout.window}, {total:.0f} e- each, dark {dark:.1f} ADU")
    print("   e-  read        mode            no TV               TV        difference   k  k, TV  strength")
    rng = np.random.default_rng(2015)
    for flux in FLUXES_E:
        thinned = [rng.binomial(np.rint(stack).astype(np.int64), flux / total) for stack in full]
        for read_noise in arguments.read_noise:
            frames = [
                (stack + read_noise * rng.standard_normal(stack.shape)).astype(np.float32)
                for stack in thinned
            ]
            strength = float(suggested_strength(read_noise, flux, layout.pixels))
            for mode, kept in (("best k", KEPT), (f"fixed k={FIXED}", (FIXED,))):
                plain = [fs.Settings("brightest", keep_brightest=k) for k in kept]
                tv = [
                    fs.Settings(noise_std=strength * f, keep_brightest=k)
                    for f in STRENGTH_FACTORS
                    for k in kept
                ]
                (without, r0), (with_tv, r1) = (best(c, layout, frames, bright) for c in (plain, tv))
                n = np.sqrt(r0.size)
                numbers = "  ".join(f"{r.mean():7.4f} ± {r.std() / n:.4f}" for r in (r0, r1, r0 - r1))
                chosen = (
                    f"{without.keep_brightest:3d}    {with_tv.keep_brightest:3d}      {with_tv.noise_std:.2f}"
                )
                print(f"{flux:5d}  {read_noise:4.1f} {mode:>11}  {numbers} {chosen}")


if __name__ == "__main__":
    main()
