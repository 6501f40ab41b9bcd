"""What is a learnt PSF worth on real spots at low light? Learn it from thinned frames, and compare.

Takes bright frames of a static field and thins their electrons as `thinned_spots.py` does, every frame moved
by up to 2 unbinned pixels before binning. From half of the frames, at that low light, a PSF is learnt; the
other half is measured: by brightest pixels, and by maximum likelihood with an analytic PSF, with the learnt
one, and with one for each lenslet learnt at full light. The truth is each estimator's own position in the
mean frame. Printed are the slope error R and the photon efficiency against the Cramer-Rao bound with the
PSF from bright frames.

    python examples/learnt_psf.py bench.npz --gain 2.1
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray
from thinned_spots import binned, moved

import faintspot as fs
from faintspot.io import open_frames
from faintspot.simulate import Detector
from faintspot.training.psf_learning import LearntPSF, learn_psf_from_images

CASES = ((30, 0.1), (50, 0.1), (100, 0.1), (200, 0.1), (1000, 0.1), (100, 3.0), (200, 3.0), (1000, 3.0))
SHIFTS = [(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3)]
KEPT = (6, 8, 10, 12, 16, 20, 25, 30, 40, 60)
BRIGHT_READ_NOISE_E = 15.0
SEARCH_PX = 3.0


class Bench:
    """Windows of every frame, moved at random, and of the mean frame, moved alike."""

    def __init__(self, electrons: NDArray[Any], factor: int, repeats: int, rng: np.random.Generator) -> None:
        layout = fs.Layout.from_frame(binned(electrons, factor).mean(axis=0), move_windows=False)
        self.n, self.window = len(layout), layout.window
        self.shift = rng.integers(len(SHIFTS), size=(len(electrons), repeats))
        self.windows = np.stack(
            [
                [layout.images(binned(moved(frame[None], *SHIFTS[s]), factor))[0] for s in row]
                for frame, row in zip(electrons, self.shift, strict=True)
            ]
        )
        mean = electrons.mean(axis=0, keepdims=True)
        self.mean = np.stack([layout.images(binned(moved(mean, *shift), factor))[0] for shift in SHIFTS])
        self.flux = float(self.mean.sum(axis=(2, 3)).mean())

    def images(self, first: int) -> NDArray[Any]:
        """Return every second frame's windows as one stack."""
        return self.windows[first::2].reshape(-1, *self.window)

    def truth(self, first: int, positions_of_mean: NDArray[Any]) -> NDArray[Any]:
        """Return the positions of the mean frame for the spots of `images`."""
        per_shift = positions_of_mean.reshape(len(SHIFTS), self.n, 2)
        return per_shift[self.shift[first::2].ravel()].reshape(-1, 2)


def positions(
    images: NDArray[Any], settings: fs.Settings, read_noise: float, learnt: Any = None, share: float = 1.0
) -> NDArray[Any]:
    """Measure spots; `learnt` holds PSF and background, the latter times `share`."""
    if learnt is None:
        slopes = fs.estimators.measure(images, settings)
        return np.stack([slopes.x, slopes.y], axis=-1)
    psf, background = learnt
    index = np.tile(np.arange(len(psf.samples)), len(images) // len(psf.samples))
    level = float(np.mean(background)) * share
    calibration = fs.Calibration(dark=level, read_noise_e=read_noise, background_e=max(level, 0.0))
    slopes = fs.estimators.measure(
        images, settings, calibration=calibration, psf=fs.PSF(psf.samples, psf.oversampling, index)
    )
    return np.stack([slopes.x, slopes.y], axis=-1)


def learnt_from(images: NDArray[Any], read_noise: float, index: Any = None) -> tuple[fs.PSF, NDArray[Any]]:
    """Learn PSF and background."""
    found: LearntPSF = learn_psf_from_images(
        images, calibration=fs.Calibration(read_noise_e=read_noise), index=index, rng=np.random.default_rng(1)
    )
    return found.psf, found.background_e


def compare(
    bench: Bench, flux: float, read_noise: float, bright: Any, one: Any, rng: np.random.Generator
) -> str:
    """Return a line: errors of all arms, the bound, photon efficiencies."""
    share = flux / bench.flux
    thin = [
        rng.binomial(np.rint(bench.images(half)).astype(np.int64), share)
        + read_noise * rng.standard_normal(bench.images(half).shape)
        for half in range(2)
    ]
    full = bench.mean.reshape(-1, *bench.window)

    def error(settings: fs.Settings, arm: Any = None) -> float:
        truth = bench.truth(1, positions(full, settings, BRIGHT_READ_NOISE_E, arm, 1 / share))
        return float(np.abs(positions(thin[1], settings, read_noise, arm) - truth).mean())

    analytic = fs.PSF.analytic("diffraction"), one[1] * share
    learnt = [learnt_from(thin[0][: 4 * bench.n], read_noise), learnt_from(thin[0], read_noise)]
    ml = fs.Settings(estimator="ml", search_range_px=SEARCH_PX)
    errors = [min(error(fs.Settings(denoise=False, keep_brightest=k)) for k in KEPT)]
    errors += [error(ml, arm) for arm in (analytic, *learnt, (bright[0], bright[1] * share))]
    background = float(one[1][0])
    light = flux - background * share * np.prod(bench.window)
    conditions: dict[str, Any] = {
        "shape": bench.window,
        "psf": one[0],
        "detector": Detector(read_noise_e=read_noise, background_e=background * share),
        "position_range_px": 1.5,
    }
    bound = np.sqrt(2 / np.pi) * float(np.mean(fs.cramer_rao(light, **conditions)))
    efficiency = fs.photon_efficiency(np.array(errors), light, **conditions)
    numbers = "".join(f"{value:10.4f}" for value in (*errors, bound))
    return f"{flux:5.0f} {read_noise:4.1f}{numbers}  | " + " ".join(f"{e:.2f}" for e in efficiency)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("frames", nargs="+")
    parser.add_argument("--gain", type=float, default=1.0, help="electrons per ADU")
    parser.add_argument("--dark", type=float, help="ADU; default: 1st percentile of the mean frame")
    parser.add_argument("--bin", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3, help="thinned copies of each frame")
    arguments = parser.parse_args()
    with open_frames(arguments.frames) as source:
        raw = source.block(0, source.n_frames).astype(np.float64)
    dark = np.percentile(raw.mean(axis=0), 1) if arguments.dark is None else arguments.dark
    rng = np.random.default_rng(2015)
    electrons = np.maximum((raw - dark) * arguments.gain, 0)
    bench = Bench(electrons, arguments.bin, arguments.repeats, rng)
    train = bench.images(0)
    lenslet = np.tile(np.arange(bench.n), len(train) // bench.n)
    bright = learnt_from(train, BRIGHT_READ_NOISE_E, lenslet)
    one = learnt_from(train, BRIGHT_READ_NOISE_E)
    light = bench.flux - one[1][0] * np.prod(bench.window)
    print(f"{bench.n} lenslets of {bench.window}, {bench.flux:.0f} e- each, {light:.0f} e- above background")
    print("   e- read brightest  analytic 200 spots all spots    bright     bound  | efficiency of each")
    for flux, read_noise in CASES:
        print(compare(bench, flux, read_noise, bright, one, rng), flush=True)


if __name__ == "__main__":
    main()
