"""What is a learnt PSF worth on real spots at low light? Learn it from thinned frames, and compare.

Takes bright frames of a static field and thins their electrons as `thinned_spots.py` does, every frame moved
by up to 2 unbinned pixels before binning. From half of the frames, at that low light, a PSF is learnt; the
other half is measured: by brightest pixels (with the best number of them); with the learnt PSF's width, and
settings found by themselves, by TV, smoothing and weighting; by maximum likelihood with an analytic PSF,
with the learnt one (from 200 spots, and from all) and with one for each lenslet learnt at full light; and
with the learnt PSF and a prior on the position. The truth is each estimator's own position in the mean
frame. Printed are the slope error R, the photon efficiency against the Cramer-Rao bound with the PSF from
bright frames, and for the last three the actual over the stated standard error.

    python -m benchmarks.frames.learnt_psf bench.npz --gain-e-per-adu 2.1
"""

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.frames.thinned_spots import binned, moved
from faintspot.io import open_frames
from faintspot.slopes.simulate import Detector
from faintspot.slopes.training.psf_learning import LearntPSF, learn_psf_from_images

CASES = ((30, 0.1), (50, 0.1), (100, 0.1), (200, 0.1), (1000, 0.1), (100, 3.0), (200, 3.0), (1000, 3.0))
SHIFTS = [(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3)]
KEPT = (6, 8, 10, 12, 16, 20, 25, 30, 40, 60)
BRIGHT_READ_NOISE_E = 15.0
SEARCH_PX = 1.5  # positions lie within about as much
PRIOR_PX = 0.8  # their standard deviation


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
) -> fs.Slopes:
    """Measure spots; `learnt` holds PSF and background, the latter times `share`."""
    if learnt is None:
        return fs.measure_images(images, settings)
    psf, background = learnt
    index = np.tile(np.arange(len(psf.samples)), len(images) // len(psf.samples))
    level = float(np.mean(background)) * share
    calibration = fs.Calibration(dark=level, read_noise_e=read_noise, background_e=max(level, 0.0))
    return fs.measure_images(
        images, settings, calibration=calibration, psf=fs.PSF(psf.samples, psf.oversampling, index)
    )


def place(slopes: fs.Slopes) -> NDArray[Any]:
    """Return x and y, (n, 2)."""
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
    """Return a line: errors of all methods, the bound, photon efficiencies."""
    share = flux / bench.flux
    thin = [
        rng.binomial(np.rint(bench.images(half)).astype(np.int64), share)
        + read_noise * rng.standard_normal(bench.images(half).shape)
        for half in range(2)
    ]
    full = bench.mean.reshape(-1, *bench.window)
    ml = fs.Settings(estimator="ml", search_range_px=SEARCH_PX)
    ratios: list[float] = []  # actual over stated standard error, of errors below 1 px

    def error(settings: fs.Settings, method: Any = None) -> float:
        at_full_flux = ml if settings.estimator.takes_prior else settings
        truth = bench.truth(1, place(positions(full, at_full_flux, BRIGHT_READ_NOISE_E, method, 1 / share)))
        slopes = positions(thin[1], settings, read_noise, method)
        found = place(slopes) - truth
        stated = np.stack([slopes.standard_error_x, slopes.standard_error_y], axis=-1)
        near = np.all((np.abs(found) < 1.0) & np.isfinite(stated), axis=-1)
        if method is not None:
            ratios.append(float(np.sqrt(np.mean(found[near] ** 2) / np.mean(stated[near] ** 2))))
        return float(np.abs(found).mean())

    analytic = fs.PSF.analytic("diffraction"), one[1] * share
    learnt = [learnt_from(thin[0][: 4 * bench.n], read_noise), learnt_from(thin[0], read_noise)]
    errors = [min(error(fs.Settings("brightest", keep_brightest=k, search_range_px=SEARCH_PX)) for k in KEPT)]
    found_by_themselves: dict[str, dict[str, Any]] = {
        "tv": {"noise_std": "auto", "keep_brightest": "auto"},
        "smoothed": {"keep_brightest": "auto"},
        "weighted": {},
    }
    for name, automatic in found_by_themselves.items():  # with the learnt PSF's width
        errors.append(error(ml.replace(estimator=name, flux_e=flux, **automatic), learnt[1]))
    errors += [error(ml, method) for method in (analytic, *learnt, (bright[0], bright[1] * share))]
    errors += [error(ml.replace(estimator="map", prior_std_px=PRIOR_PX, flux_e=flux), learnt[1])]
    background = float(one[1][0])
    net_flux = flux - background * share * np.prod(bench.window)
    conditions: dict[str, Any] = {
        "shape": bench.window,
        "psf": one[0],
        "detector": Detector(read_noise_e=read_noise, background_e=background * share),
        "position_range_px": 1.5,
    }
    bound = np.sqrt(2 / np.pi) * float(np.mean(fs.cramer_rao(net_flux, **conditions)))
    efficiency = fs.photon_efficiency(np.array(errors), net_flux, **conditions)
    numbers = "".join(f"{value:10.4f}" for value in (*errors, bound))
    shown = " ".join(f"{e:.2f}" for e in efficiency), " ".join(f"{r:.2f}" for r in ratios[-3:])
    return f"{flux:5.0f} {read_noise:4.1f}{numbers}  | {shown[0]} | {shown[1]}"


def _flux_between(raw: NDArray[Any], arguments: argparse.Namespace) -> float:
    """Return the level (ADU) on which the spots stand: dark level and background that the PSF's fit finds."""
    dark = float(np.percentile(raw.mean(axis=0), 1))
    electrons = np.maximum((raw - dark) * arguments.gain, 0)
    bench = Bench(electrons, arguments.bin, 1, np.random.default_rng(2015))
    _, background = learnt_from(bench.images(0), BRIGHT_READ_NOISE_E)
    return float(dark + background[0] / arguments.bin**2 / arguments.gain)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("frames", nargs="+")
    parser.add_argument("--gain-e-per-adu", dest="gain", type=float, default=1.0, help="electrons per ADU")
    parser.add_argument("--dark", type=float, help="ADU; default: the light between the spots")
    parser.add_argument("--bin", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3, help="thinned copies of each frame")
    arguments = parser.parse_args()
    with open_frames(arguments.frames) as source:
        raw = source.block(0, source.n_frames).astype(np.float64)
    dark = _flux_between(raw, arguments) if arguments.dark is None else arguments.dark
    electrons = np.maximum((raw - dark) * arguments.gain, 0)
    bench = Bench(electrons, arguments.bin, arguments.repeats, np.random.default_rng(2015))
    rng = np.random.default_rng(1503)
    train = bench.images(0)
    lenslet = np.tile(np.arange(bench.n), len(train) // bench.n)
    bright = learnt_from(train, BRIGHT_READ_NOISE_E, lenslet)
    one = learnt_from(train, BRIGHT_READ_NOISE_E)
    net_flux = bench.flux - one[1][0] * np.prod(bench.window)
    print(f"dark level {dark:.1f} ADU")
    print(
        f"{bench.n} lenslets of {bench.window}, {bench.flux:.0f} e- each, {net_flux:.0f} e- above background"
    )
    names = (
        "brightest",
        "TV",
        "smoothed",
        "weighted",
        "analytic",
        "200 spots",
        "all spots",
        "bright",
        "prior",
        "bound",
    )
    heading = "".join(f"{name:>10}" for name in names)
    print(f"   e- read{heading}  | {'efficiencies':44} | actual / stated")
    for flux, read_noise in CASES:
        print(compare(bench, flux, read_noise, bright, one, rng), flush=True)


if __name__ == "__main__":
    main()
