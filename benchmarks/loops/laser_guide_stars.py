"""What does the profile of the sodium layer gain, learnt from frames and followed?

Prints Markdown tables for an 8 m telescope with 20 x 20 sub-apertures and a laser launched from its side:
flux needed for equal wavefront errors, and the photon efficiency of every sub-aperture. Errors: jackknife
over frames. Then, also for the size of an ELT, what windows that cut off spots do to slopes; there all
methods know the profile.

    python -m benchmarks.loops.laser_guide_stars
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.cli.output import progress_bar
from faintspot.slopes.training import MeanImages, fit_spot
from faintspot.slopes.wavefront.zernike import mean_gradients

DIAMETER_M, LENSLETS, OBSTRUCTION_M = 8.0, 20, 1.2
LAUNCH_M, SITE_M, ZENITH_DEG = (-5.0, 0.0), 2600.0, 30.0
PIXEL_ARCSEC, READ_NOISE_E = 0.5, 1.0
MOTION_PX = 0.2  # residual slopes, on each axis
NARROWEST_ARCSEC = 0.6  # spot from which the fit begins: diffraction and pixels
FLUXES = (60.0, 120.0, 240.0, 480.0, 960.0)
EQUAL_AT = (120.0, 480.0)  # flux of the weighted centre of gravity whose wavefront error is the aim
MODES = np.arange(2, 137)
FRAMES_TO_LEARN = 2000
PARTS = 10
SINGLE = fs.SodiumProfile.gaussian(90e3, 10e3)
DOUBLE = fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], [0.6, 0.4])
ALTITUDES = np.linspace(76e3, 104e3, 41)

Floats = NDArray[np.float64]
Advance = Callable[[int], None]


class Case(NamedTuple):
    """Sensor and layer."""

    name: str
    profile: fs.SodiumProfile
    fwhm_arcsec: float
    side: int


CASES = (
    Case("one layer, 1.2 arcsec", SINGLE, 1.2, 10),
    Case("two layers, 1.2 arcsec", DOUBLE, 1.2, 10),
    Case("two layers, 0.9 arcsec", DOUBLE, 0.9, 10),
    Case("two layers, 0.9 arcsec", DOUBLE, 0.9, 16),
)


def subapertures_m(diameter_m: float, lenslets: int, obstruction_m: float) -> Floats:
    """Return the centres of the sub-apertures in the pupil."""
    place = (np.arange(lenslets) - (lenslets - 1) / 2) * diameter_m / lenslets
    x, y = np.meshgrid(place, place)
    distance = np.hypot(x, y)
    lit = (distance < diameter_m / 2) & (distance >= obstruction_m / 2)
    return np.column_stack([x[lit], y[lit]])


PLACES = subapertures_m(DIAMETER_M, LENSLETS, OBSTRUCTION_M)
N = len(PLACES)
DETECTOR = fs.slopes.simulate.Detector(READ_NOISE_E)
CALIBRATION = fs.Calibration(read_noise_e=READ_NOISE_E)


def star_of(fwhm_arcsec: float) -> fs.LaserGuideStar:
    """Return the star with a round spot of this width."""
    spot = fs.PSF.analytic("gaussian", size=fwhm_arcsec / PIXEL_ARCSEC / 2, radius_px=8)
    return fs.LaserGuideStar(PLACES, LAUNCH_M, PIXEL_ARCSEC, spot, ZENITH_DEG, SITE_M)


def layout_of(side: int) -> fs.Layout:
    """Return windows side by side in one row."""
    return fs.Layout.grid((1, N), pixels=side)


def wavefront_matrix() -> Floats:
    """Return the matrix from slopes [px], all x then all y, to Zernike coefficients of `MODES` [nm rms]."""
    half = 0.5 * DIAMETER_M / LENSLETS
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    radius = DIAMETER_M / 2
    gradients = np.concatenate(mean_gradients(MODES, (PLACES[:, None] + corners) / radius))
    slope_px = gradients / radius * 1e-9 * 180 * 3600 / np.pi / PIXEL_ARCSEC
    return np.asarray(np.linalg.pinv(slope_px), np.float64)


MATRIX = wavefront_matrix()


def frames_of(psf: fs.PSF, side: int, flux: float, n: int, seed: int) -> tuple[Any, Floats]:
    """Return frames and the positions of their spots (n, N, 2)."""
    layout, rng = layout_of(side), np.random.default_rng(seed)
    return fs.slopes.simulate.sensor_frames(
        layout, n, flux_e=flux, psf=psf, detector=DETECTOR,
        rng=rng, positions=rng.normal(0.0, MOTION_PX, (n, N, 2)),
    )  # fmt: skip


def mean_of(star: fs.LaserGuideStar, profile: fs.SodiumProfile, side: int, flux: float, n: int, seed: int,
            positions: Floats | None = None) -> MeanImages:  # fmt: skip
    """Return the mean of n frames; slopes are taken to be 0, as a loop leaves them on average."""
    moving = replace(star, spot=star.spot.blurred(MOTION_PX))
    rng = np.random.default_rng(seed)
    images = np.maximum(moving.images(profile, (side, side), positions), 0.0)  # of splines
    images *= flux / images.sum(axis=(1, 2), keepdims=True)
    drawn = rng.poisson(n * images) / n + rng.normal(0.0, READ_NOISE_E / np.sqrt(n), images.shape)
    return MeanImages(drawn, np.zeros((N, 2)), frames=n)


class Known(NamedTuple):
    """PSFs that a method may use."""

    start: fs.PSF
    """A single layer with the fitted spot."""
    followed: fs.PSF


def learnt(case: Case, star: fs.LaserGuideStar, profile: fs.SodiumProfile) -> Known:
    """Return what mean images of the lowest flux show of spot and profile; they are not scored."""
    first = SINGLE.at(ALTITUDES)
    mean = mean_of(star, profile, case.side, min(FLUXES), FRAMES_TO_LEARN, seed=7)
    narrow = star_of(NARROWEST_ARCSEC)
    found, fit = fit_spot(mean, narrow, first, dark_variance_e2=READ_NOISE_E**2)
    radius = case.side / 2 + 3
    single = found.focused(first)
    return Known(found.psf(single, radius_px=radius), found.psf(fit.profile, radius_px=radius))


def pipelines(case: Case, known: Known, flux: float) -> Iterator[tuple[str, fs.SlopePipeline]]:
    """Yield candidates by the name of their method."""
    layout, side = layout_of(case.side), (case.side, case.side)
    window = fs.Settings("window", flux_e=flux)
    noise = {"flux_e": flux, "read_noise_e": READ_NOISE_E}

    def made(settings: fs.Settings, psf: fs.PSF, score: Any = None) -> fs.SlopePipeline:
        return fs.SlopePipeline(layout, settings, CALIBRATION, psf=psf, weights=score)

    for width in (2.5, 3.2, 4.0, 5.0, 6.3, 8.0):
        gaussian = fs.Settings("window", flux_e=flux, window_fwhm_px=width)
        for psf in known:  # which gives elongation and gain
            yield "weighted centre of gravity", made(gaussian, psf)
    for power in (0.2, 0.35, 0.5, 0.7, 1.0):
        shaped = fs.FixedWeights.shaped(known.followed, side, power=power)
        yield "weights of the followed shape", made(window, known.followed, shaped)
    for name, psf in (("single layer", known.start), ("followed", known.followed)):
        filters = fs.FixedWeights.matched(psf, side, **noise)
        yield f"linear matched filter, {name}", made(window, psf, filters)
        yield f"ml, {name}", made(fs.Settings("ml", search_range_px=2.0), psf)


class Measured(NamedTuple):
    """Result of a method."""

    squares: Floats
    """Wavefront error of each part of the frames [nm^2]."""
    gain: Floats
    """Mean slope measured for a displacement of 1 px, (2,)."""
    zero: Floats
    """Mean slope of each sub-aperture for a displacement of 0, (N, 2)."""


def measured(pipeline: fs.SlopePipeline, frames: Any, truth: Floats, known: Any = None) -> Measured:
    """Measure frames; gain and references are those of another result, or of these frames."""
    slopes = pipeline(frames)
    found = np.stack([slopes.x, slopes.y], axis=-1)
    if known is None:
        gain = (found * truth).sum(axis=(0, 1)) / np.square(truth).sum(axis=(0, 1))
        zero = (found - gain * truth).mean(axis=0)
    else:
        gain, zero = known.gain, known.zero
    away = (found - zero) / gain - truth
    modes = np.concatenate([away[..., 0], away[..., 1]], axis=1) @ MATRIX.T
    squares = np.square(modes[:, MODES > 3]).sum(axis=1)
    return Measured(np.array([part.mean() for part in np.array_split(squares, PARTS)]), gain, zero)


def flux_at(errors: list[Floats], aim: float) -> float:
    """Return the flux that gives a mean square wavefront error, on a line between logarithms."""
    means = np.log([each.mean() for each in errors])
    return float(np.exp(np.interp(-np.log(aim), -means, np.log(FLUXES))))


def flux_table(case: Case, n: int, advance: Advance) -> None:
    """Print wavefront errors against flux, and the flux needed for equal errors."""
    star = star_of(case.fwhm_arcsec)
    profile = star.focused(case.profile)
    psf = star.psf(profile)
    scored: dict[str, list[Floats]] = {}
    known = learnt(case, star, profile)
    for flux in FLUXES:
        tuning = frames_of(psf, case.side, flux, n // 2, seed=1)
        scoring = frames_of(psf, case.side, flux, n, seed=2)
        best: dict[str, tuple[fs.SlopePipeline, Measured]] = {}
        for name, pipeline in pipelines(case, known, flux):
            tried = measured(pipeline, *tuning)
            if name not in best or tried.squares.mean() < best[name][1].squares.mean():
                best[name] = pipeline, tried
        for name, (pipeline, tried) in best.items():
            scored.setdefault(name, []).append(measured(pipeline, *scoring, tried).squares)
        advance(1)
    print(f"\n### {case.name}, {case.side} px\n")
    print("| method | " + " | ".join(f"{flux:g} e-" for flux in FLUXES), end=" | ")
    print(" | ".join(f"flux needed, as at {flux:g} e-" for flux in EQUAL_AT) + " |")
    print("|---" * (1 + len(FLUXES) + len(EQUAL_AT)) + "|")
    usual = scored["weighted centre of gravity"]
    for name, errors in scored.items():
        cells = [f"{np.sqrt(each.mean()):.0f}" for each in errors]
        for flux in EQUAL_AT:
            at = FLUXES.index(flux)

            def ratio(keep: Any, at: int = at, flux: float = flux, errors: list[Floats] = errors) -> float:
                return flux_at([each[keep] for each in errors], float(usual[at][keep].mean())) / flux

            without = [ratio(np.arange(PARTS) != part) for part in range(PARTS)]
            error = np.sqrt((PARTS - 1) * np.var(without))
            cells.append(f"{ratio(np.arange(PARTS)):.3f} ± {error:.3f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


# Photon efficiency of every sub-aperture -------------------------------------------------------------

EFFICIENCY_FLUXES = (120.0, 240.0, 480.0)
SPOTS = 8000


def efficiency_table(case: Case, advance: Advance) -> None:
    """Print the photon efficiency of `ml` with the learnt profile, in one of two symmetric halves."""
    star = star_of(case.fwhm_arcsec)
    profile = star.focused(case.profile)
    kept = np.flatnonzero(PLACES[:, 1] > 0)[::2]
    psf, followed = (_of(each, kept) for each in (star.psf(profile), learnt(case, star, profile).followed))
    layout = fs.Layout.grid((1, len(kept)), pixels=case.side)
    print(f"\n### {case.name}, {case.side} px\n")
    print("| flux | mean | lowest | 5 % | below 0.9 | known profile: mean | lowest |")
    print("|---" * 7 + "|")
    for flux in EFFICIENCY_FLUXES:
        rng = np.random.default_rng(int(flux))
        frames, truth = fs.slopes.simulate.sensor_frames(
            layout, SPOTS, flux_e=flux, psf=psf, detector=DETECTOR,
            rng=rng, positions=rng.normal(0.0, MOTION_PX, (SPOTS, len(kept), 2)),
        )  # fmt: skip
        steps = np.geomspace(0.3, 1.1, 6)
        side = (case.side, case.side)
        bounds = [fs.cramer_rao_covariance(step * flux, psf, side, detector=DETECTOR) for step in steps]
        traces = np.trace(bounds, axis1=2, axis2=3)
        cells = []
        for known in (followed, psf):
            settings = fs.Settings("ml", search_range_px=2.0)
            slopes = fs.SlopePipeline(layout, settings, CALIBRATION, psf=known)(frames)
            squares = np.square(slopes.x - truth[..., 0]) + np.square(slopes.y - truth[..., 1])
            found = squares.mean(axis=0)
            values = [
                np.exp(np.interp(-np.log(v), -np.log(t), np.log(steps)))
                for v, t in zip(found, traces.T, strict=True)
            ]
            cells.append(np.array(values))
        own, best = cells
        spread = np.square(squares).mean(axis=0) / found**2 - 1
        error = float(np.sqrt(spread.mean() / SPOTS))
        low, few = np.quantile(own, 0.05), np.mean(own < 0.9)
        text = f"{own.mean():.3f} | {own.min():.3f} ± {error:.3f} | {low:.3f} | {100 * few:.0f} %"
        print(f"| {flux:g} e- | {text} | {best.mean():.3f} | {best.min():.3f} |", flush=True)
        advance(1)


def _of(psf: fs.PSF, kept: NDArray[np.int64]) -> fs.PSF:
    """Return the PSFs of some sub-apertures."""
    return fs.PSF(psf.samples[kept], psf.oversampling, range(len(kept)))


# Windows that cut off spots --------------------------------------------------------------------------

EDGES = (0.0, 0.01, 0.05, 0.15, 0.3, 1.0)  # parts of the flux that are cut off
CUT_FLUX_E, CUT_FRAMES, STEP_PX = 300.0, 200, 0.3


class Cutting(NamedTuple):
    """Telescope and sensor."""

    name: str
    diameter_m: float
    lenslets: int
    launch_m: float
    pixel_arcsec: float
    side: int
    every: int
    """Of this number of sub-apertures one is measured."""
    width_px: float
    """Width of the Gaussian window."""


CUTTING = (
    Cutting("8 m, 20 x 20, launched 5 m off-axis", 8.0, 20, -5.0, 0.5, 6, 2, 5.0),
    Cutting("39 m, 80 x 80, launched 40 m off-axis", 39.0, 80, -40.0, 1.0, 16, 31, 16.0),
    Cutting("39 m, 80 x 80, launched 40 m off-axis", 39.0, 80, -40.0, 1.0, 10, 31, 16.0),
)


def cutting_pipelines(layout: fs.Layout, psf: fs.PSF, width_px: float) -> dict[str, fs.SlopePipeline]:
    """Return the methods; spots are within 2 px of the reference."""
    weights = fs.FixedWeights.matched(psf, layout.window, flux_e=CUT_FLUX_E, read_noise_e=READ_NOISE_E)
    window = fs.Settings("window", window_fwhm_px=width_px, spot_fwhm_px=width_px, normalisation="frame")
    ml = fs.Settings("ml", search_range_px=2.0)
    return {
        "weighted centre of gravity": fs.SlopePipeline(layout, window, CALIBRATION),
        "linear matched filter": fs.SlopePipeline(layout, window, CALIBRATION, weights=weights),
        "ml": fs.SlopePipeline(layout, ml, CALIBRATION, psf=psf),
    }


def cutting_table(case: Cutting) -> None:
    """Print offset, gain along the elongation and error over the bound, by the part that is cut off."""
    places = subapertures_m(case.diameter_m, case.lenslets, 0.0)[:: case.every]
    spot = fs.PSF.analytic("gaussian", size=1.2 / case.pixel_arcsec / 2, radius_px=8)
    star = fs.LaserGuideStar(places, (case.launch_m, 0.0), case.pixel_arcsec, spot, ZENITH_DEG, SITE_M)
    profile, side = star.focused(DOUBLE), case.side
    along = star.elongation_px(profile)
    along = along / np.hypot(*along.T)[:, None]
    layout, psf = fs.Layout.grid((1, len(star)), pixels=side), star.psf(profile, radius_px=side / 2 + 3)

    def frame(step: float) -> Floats:
        images = np.maximum(star.images(profile, (side, side), step * along), 0.0)
        return images.swapaxes(0, 1).reshape(side, -1)

    groups = np.digitize(1.0 - layout.images(frame(0.0)).sum(axis=(1, 2)), EDGES[1:-1])
    drawn = np.random.default_rng(1).poisson(CUT_FLUX_E * frame(0.0), (CUT_FRAMES, side, side * len(star)))
    noisy = drawn + np.random.default_rng(2).normal(0.0, READ_NOISE_E, drawn.shape)
    bound = fs.cramer_rao_covariance(CUT_FLUX_E, psf, (side, side), detector=DETECTOR)
    least = np.sqrt(np.trace(bound, axis1=1, axis2=2))
    shown = [groups == group for group in np.unique(groups)]
    parts = [f"{100 * EDGES[k]:g} to {100 * EDGES[k + 1]:g} % cut off" for k in np.unique(groups)]
    print(f"\n### {case.name}, {side} px of {case.pixel_arcsec:g} arcsec\n")
    print("| slope at the reference [px rms]; gain; error / bound | " + " | ".join(parts) + " |")
    print("|---" * (1 + len(shown)) + "|")
    for name, pipeline in cutting_pipelines(layout, psf, case.width_px).items():
        ends = (pipeline(1e4 * frame(step)) for step in (STEP_PX, -STEP_PX))
        ahead, behind = ((np.stack([each.x, each.y], axis=1) * along).sum(axis=1) for each in ends)
        offset, gain = 0.5 * (ahead + behind), (ahead - behind) / (2 * STEP_PX)
        found = pipeline(noisy)
        error = np.sqrt(found.x.var(axis=0) + found.y.var(axis=0)) / np.maximum(gain, 0.1) / least
        rms = [np.sqrt(np.square(offset[own]).mean()) for own in shown]
        cells = [
            f"{r:.3f}; {gain[own].mean():.2f}; {np.median(error[own]):.2f}"
            for r, own in zip(rms, shown, strict=True)
        ]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Measure what a followed sodium profile gains.")
    parser.add_argument("--frames", type=int, default=200, help="Frames that are scored. [default: 200]")
    parser.add_argument("--parts", nargs="*", default=["efficiency", "flux", "cutting"], help="Tables.")
    chosen = parser.parse_args()
    steps = {"efficiency": 3 * len(CASES[:-1]), "flux": len(CASES) * len(FLUXES), "cutting": 3}
    total, done = sum(steps[part] for part in chosen.parts), 0
    with progress_bar("Laser guide stars", "steps") as show:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            show(done, total)

        if "efficiency" in chosen.parts:
            print("\n## Photon efficiency of ml with the learnt profile, of all sub-apertures")
            for case in CASES[:-1]:  # windows of 10 px
                efficiency_table(case, advance)
        if "flux" in chosen.parts:
            print("\n## Wavefront error [nm rms] of a frame, Zernike modes 4 to 136")
            for case in CASES:
                flux_table(case, chosen.frames, advance)
        if "cutting" in chosen.parts:
            print("\n## Windows that cut off spots")
            for cutting in CUTTING:
                cutting_table(cutting)
                advance(1)


if __name__ == "__main__":
    main()
