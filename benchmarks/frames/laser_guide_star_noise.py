"""What does the 2 x 2 covariance of a laser guide star's slopes gain, and do its ellipses hold 95 %?

Prints Markdown tables for an 8 m telescope with 20 x 20 sub-apertures, open loop: residual wavefront of the
minimum-variance reconstructor and noise of weighted least squares, with equal weights, with the variances of
x and y, and with their covariance; then the same for the predictions of Kalman filters, and the share of true
positions within the stated ellipses. The slopes are those of `ml` with the known profile, those of the
filters have the noise of the Cramer-Rao bound. Errors: standard error over wavefronts, or blocks of frames.

    python -m benchmarks.frames.laser_guide_star_noise
"""

import argparse
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.loops import laser_guide_stars as laser
from faintspot.cli.output import progress_bar
from faintspot.loop.control.flattening import phase_of_commands
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor
from faintspot.loop.control.reconstructor import add_noise, weighted_slopes
from faintspot.loop.slope_covariance import SlopeTurbulence, phase_covariance_rad2

Floats = NDArray[np.float64]

R0_M, OUTER_SCALE_M, NM_PER_RAD = 0.15, 25.0, 500.0 / (2 * np.pi)
FWHM_ARCSEC = 1.2
SUBAPERTURE_M = laser.DIAMETER_M / laser.LENSLETS
FLUXES = (60.0, 200.0, 600.0)
COVERAGE_FLUXES = (15.0, 30.0, 60.0, 120.0, 250.0, 500.0, 1000.0)
OF_95_PERCENT = 5.991  # squared Mahalanobis distance, of two dimensions
WEIGHTS = ("equal", "variances", "covariances")
RATE_HZ, DELAY_FRAMES, RADIUS_M = 500.0, 2, 2.0  # of the filters; sub-apertures this near to the centre
FRACTION, WIND_M_PER_S = (0.65, 0.35), ((9.0, 4.0), (-12.0, 18.0))
SETTLE_FRAMES, BLOCK_FRAMES = 100, 100


class Launch(NamedTuple):
    """Place of the launch telescope, and windows."""

    distance_m: float
    angle_deg: float
    side: int

    @property
    def text(self) -> str:
        """Place and window as in the tables."""
        return f"{self.distance_m:g} m, {self.angle_deg:g}°, {self.side} px"


LAUNCHES = tuple(
    Launch(*place, side)
    for place in ((5.0, 0.0), (5.0, 45.0), (20.0, 0.0), (20.0, 45.0))
    for side in (10, 16)
)


class Atmosphere(NamedTuple):
    """Wavefronts on points, four to a sub-aperture's area, and their slopes."""

    root: Floats
    """(points, points): from normal numbers to wavefronts [nm]."""
    gradients: Floats
    """(2 n, points): from wavefronts to mean slopes [px]."""
    slopes: Floats
    """(2 n, 2 n): covariance of slopes [px^2]."""
    crossed: Floats
    """(points, 2 n): covariance of wavefronts and slopes [nm px]."""
    unseen: Floats
    """(points, 3): piston, tip and tilt, orthonormal."""


def atmosphere() -> Atmosphere:
    """Return von Karman turbulence over the lit sub-apertures."""
    half = 0.5 * SUBAPERTURE_M
    steps = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2)  # rows of y, then x
    places = np.rint((laser.PLACES[:, None] + half * steps) / half).astype(int)
    points, which = np.unique(places.reshape(-1, 2), axis=0, return_inverse=True)
    which = which.reshape(laser.N, 9)
    simpson = np.array([1.0, 4.0, 1.0]) / 6  # mean along an edge
    ends = np.array([-1.0, 0.0, 1.0])
    weights = np.outer(simpson, ends).ravel(), np.outer(ends, simpson).ravel()
    px_per_nm = 1e-9 * 180 * 3600 / np.pi / laser.PIXEL_ARCSEC / SUBAPERTURE_M
    gradients = np.zeros((2 * laser.N, len(points)))
    for axis in range(2):
        rows = np.arange(laser.N)[:, None] + axis * laser.N
        gradients[rows, which] = px_per_nm * weights[axis]
    phase = phase_covariance_rad2(half * points, R0_M, OUTER_SCALE_M) * NM_PER_RAD**2
    phase[np.diag_indices_from(phase)] *= 1 + 1e-9
    crossed = phase @ gradients.T
    unseen = np.linalg.qr(np.column_stack([np.ones(len(points)), points]))[0]
    return Atmosphere(
        np.asarray(np.linalg.cholesky(phase), np.float64), gradients, gradients @ crossed, crossed, unseen
    )


def spots_of(launch: Launch) -> fs.PSF:
    """Return the spots of every sub-aperture: one layer, 1.2 arcsec."""
    angle = np.radians(launch.angle_deg)
    place = -launch.distance_m * np.array([np.cos(angle), np.sin(angle)])
    star = replace(laser.star_of(FWHM_ARCSEC), launch_m=place)
    psf: fs.PSF = star.psf(star.focused(laser.SINGLE), radius_px=launch.side / 2 + 4)
    return psf


def measured(launch: Launch, psf: fs.PSF, flux: float, positions: Floats, seed: int) -> fs.Slopes:
    """Return slopes of spots at positions (frames, n, 2) px."""
    layout = laser.layout_of(launch.side)
    frames, _ = fs.slopes.simulate.sensor_frames(
        layout, len(positions), flux_e=flux, psf=psf,
        detector=laser.DETECTOR, rng=np.random.default_rng(seed), positions=positions,
    )  # fmt: skip
    settings = fs.Settings("ml", search_range_px=3.0)
    return fs.SlopePipeline(layout, settings, laser.CALIBRATION, psf=psf)(frames)


def noise_of(slopes: fs.Slopes, frame: int, weights: str) -> tuple[Floats, Floats | None]:
    """Return variances (2 n,) and covariances (n,) of a frame's slopes [px^2]."""
    errors = np.concatenate([slopes.standard_error_x[frame], slopes.standard_error_y[frame]])
    variance = np.square(np.minimum(errors.astype(np.float64), 1e3))
    if weights == "equal":
        return np.full(len(variance), 1 / np.mean(1 / variance)), None
    covariance = slopes.covariance_xy[frame].astype(np.float64)
    return variance, covariance if weights == "covariances" else None


def residuals(air: Atmosphere, launch: Launch, flux: float, frames: int, seed: int) -> dict[str, Floats]:
    """Return residual wavefronts of minimum variance and noise of least squares [nm rms], by weights."""
    psf = spots_of(launch)
    waves = np.random.default_rng(seed).normal(size=(frames, len(air.root))) @ air.root.T
    waves -= waves @ air.unseen @ air.unseen.T
    true = waves @ air.gradients.T
    positions = np.stack(np.split(true, 2, axis=1), axis=-1)
    slopes = measured(launch, psf, flux, positions, seed + 1)
    tilts = air.gradients @ air.unseen[:, 1:]
    tilts = 1e3 * tilts @ tilts.T / np.square(tilts).mean()  # a laser does not see them: infinite noise
    found: dict[str, Floats] = {}
    modes: Floats = np.asarray(np.linalg.pinv(laser.MATRIX), np.float64)
    for weights in WEIGHTS:
        left, noise = np.empty(frames), np.empty(frames)
        for frame in range(frames):
            variance, covariance = noise_of(slopes, frame, weights)
            seen = slopes.vector[frame].astype(np.float64)
            total = air.slopes + tilts
            add_noise(total, variance, covariance)
            rest = waves[frame] - air.crossed @ np.linalg.solve(total, seen)
            rest -= air.unseen @ (air.unseen.T @ rest)
            left[frame] = np.sqrt(np.mean(np.square(rest)))
            weighted = weighted_slopes(modes, variance, covariance)
            error = np.linalg.solve(weighted.T @ modes, weighted.T @ (seen - true[frame]))
            noise[frame] = np.sqrt(np.square(error[laser.MODES > 3]).sum())
        found[f"minimum variance, {weights}"], found[f"least squares, {weights}"] = left, noise
    return found


def gain_tables(frames: int, advance: Any) -> None:
    """Print residual wavefronts, and what variances and covariances gain [nm]."""
    air = atmosphere()
    names = "minimum variance", "least squares"
    print("\n| launch, window | flux |", end="")
    for name in names:
        print(f" {name}: {' | '.join(WEIGHTS)} | gain of covariances |", end="")
    print("\n" + "|---" * 10 + "|")
    for launch in LAUNCHES:
        for flux in FLUXES:
            found = residuals(air, launch, flux, frames, seed=int(flux))
            cells = []
            for name in names:
                rms = [found[f"{name}, {weights}"] for weights in WEIGHTS]
                gain = rms[1] - rms[2]
                cells += [f"{each.mean():.1f}" for each in rms]
                cells.append(f"{gain.mean():.1f} ± {gain.std(ddof=1) / np.sqrt(frames):.1f}")
            print(f"| {launch.text} | {flux:g} e- | " + " | ".join(cells) + " |", flush=True)
            advance(1)


def turbulence(inner: NDArray[np.bool_]) -> SlopeTurbulence:
    """Return two layers over the inner sub-apertures."""
    pixel_rad = np.radians(laser.PIXEL_ARCSEC / 3600)
    site = laser.PLACES[inner], SUBAPERTURE_M, pixel_rad, R0_M, OUTER_SCALE_M
    return SlopeTurbulence(*site, np.array(FRACTION), np.array(WIND_M_PER_S))


def slopes_of(model: SlopeModel, frames: int, rng: np.random.Generator) -> Floats:
    """Return slopes (frames, m) as the model makes them [px]."""
    roots = np.linalg.cholesky(model.driving)
    now = before = np.zeros((model.layers, model.slopes))
    slopes = np.empty((frames, model.slopes))
    for frame in range(-SETTLE_FRAMES, frames):
        chance = np.einsum("lij,lj->li", roots, rng.standard_normal(now.shape))
        kept = np.einsum("lij,lj->li", model.first, now) + np.einsum("lij,lj->li", model.second, before)
        now, before = kept + chance, now
        if frame >= 0:
            slopes[frame] = now.sum(axis=0)
    return slopes


def left_by(filtered: Any, true: Floats, noise: Floats, variance: Floats, phase: Floats) -> Floats:
    """Return the wavefront error of predictions, rms of each block of frames [nm]."""
    squares = np.empty(len(true) - DELAY_FRAMES)
    filtered.begin(true[0])
    for frame in range(len(squares)):
        filtered.correct(true[frame] + noise[frame], variance)
        error = (filtered.ahead(DELAY_FRAMES) - true[frame + DELAY_FRAMES]).reshape(2, -1)
        squares[frame] = np.square(phase @ (error - error.mean(axis=1, keepdims=True)).ravel()).sum()
        filtered.advance()
    blocks = (len(squares) - SETTLE_FRAMES) // BLOCK_FRAMES
    scored = squares[SETTLE_FRAMES : SETTLE_FRAMES + blocks * BLOCK_FRAMES]
    return np.asarray(np.sqrt(scored.reshape(blocks, -1).mean(axis=1)))


def filter_table(frames: int, advance: Any) -> None:
    """Print wavefront errors of the predictions of Kalman filters, and what covariances gain [nm]."""
    inner = np.hypot(*laser.PLACES.T) < RADIUS_M
    air, n = turbulence(inner), int(np.count_nonzero(inner))
    lagged = np.array([layer.lagged_px2(1 / RATE_HZ) for layer in air.layers()])
    model = SlopeModel.of_covariances(lagged)
    cells = np.rint(laser.PLACES[inner][:, ::-1] / SUBAPERTURE_M - 0.5).astype(int)
    to_nm = 1e9 * SUBAPERTURE_M * np.radians(laser.PIXEL_ARCSEC / 3600)
    phase = to_nm * phase_of_commands(np.eye(2 * n), cells - cells.min(axis=0))
    true = slopes_of(model, frames, np.random.default_rng(1))
    chance = np.random.default_rng(2).standard_normal((frames, n, 2))
    title = "variances | covariances | gain of covariances"
    print(f"\n| launch, window | flux | all slopes: {title} | near slopes: {title} |")
    print("|---" * 8 + "|")
    for launch in LAUNCHES[::2]:
        psf, window = spots_of(launch), (launch.side, launch.side)
        for flux in FLUXES:
            bound = fs.cramer_rao_covariance(flux, psf, window, detector=laser.DETECTOR)[inner]
            drawn = np.einsum("nij,fnj->fin", np.linalg.cholesky(bound), chance)
            noise, variance = drawn.reshape(frames, 2 * n), np.diagonal(bound, axis1=1, axis2=2).T.ravel()
            cells_of_row = []
            for kind in ("all", "near"):
                left = []
                for shared in (np.zeros(n), bound[:, 0, 1]):
                    if kind == "all":
                        made: Any = SlopePredictor(model, variance, shared, steady=True)
                    else:
                        usual = variance, None, shared
                        made = LocalPredictor(local_filter(air.layers(), 1 / RATE_HZ, *usual))
                    left.append(left_by(made, true, noise, variance, phase))
                gain = left[0] - left[1]
                cells_of_row += [f"{np.sqrt(np.square(each).mean()):.1f}" for each in left]
                cells_of_row.append(f"{gain.mean():.1f} ± {gain.std(ddof=1) / np.sqrt(len(gain)):.1f}")
            print(f"| {launch.text} | {flux:g} e- | " + " | ".join(cells_of_row) + " |", flush=True)
            advance(1)


def coverage_table(frames: int, advance: Any) -> None:
    """Print the share of true positions within the stated ellipses of 95 %, for motions as in a loop."""
    print("\n| launch, window | " + " | ".join(f"{flux:g} e-" for flux in COVERAGE_FLUXES) + " |")
    print("|---" * (1 + len(COVERAGE_FLUXES)) + "|")
    for launch in LAUNCHES:
        psf = spots_of(launch)
        rows: dict[str, list[str]] = {"covariance": [], "variances alone": []}
        for flux in COVERAGE_FLUXES:
            rng = np.random.default_rng(int(flux))
            truth = rng.normal(0.0, laser.MOTION_PX, (frames, laser.N, 2))
            slopes = measured(launch, psf, flux, truth, seed=int(flux) + 1)
            with np.errstate(divide="ignore", invalid="ignore"):
                x, y = slopes.x - truth[..., 0], slopes.y - truth[..., 1]
                xx, yy = (
                    np.square(e.astype(float)) for e in (slopes.standard_error_x, slopes.standard_error_y)
                )
                for name, xy in (
                    ("covariance", slopes.covariance_xy.astype(float)),
                    ("variances alone", 0.0),
                ):
                    squares = (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
                    inside = np.where(slopes.valid, squares < OF_95_PERCENT, np.nan)
                    rows[name].append(f"{100 * np.nanmean(inside):.1f} %")
            advance(1)
        for name, cells in rows.items():
            print(
                f"| {launch.text}, {name} | " + " | ".join(cells) + " |",
                flush=True,
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Measure what covariances of slopes gain.")
    parser.add_argument("--wavefronts", type=int, default=40, help="Wavefronts for each flux. [default: 40]")
    parser.add_argument("--frames", type=int, default=100, help="Frames for the ellipses. [default: 100]")
    parser.add_argument("--parts", nargs="*", default=["gain", "filter", "coverage"], help="Tables.")
    parser.add_argument(
        "--loop-frames", type=int, default=2602, help="Frames of the filters. [default: 2602]"
    )
    chosen = parser.parse_args()
    steps = {
        "gain": len(LAUNCHES) * len(FLUXES),
        "filter": len(LAUNCHES[::2]) * len(FLUXES),
        "coverage": len(LAUNCHES) * len(COVERAGE_FLUXES),
    }
    total, done = sum(steps[part] for part in chosen.parts), 0
    with progress_bar("Covariances of slopes", "steps") as show:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            show(done, total)

        if "gain" in chosen.parts:
            print("\n## Residual wavefront [nm rms]")
            gain_tables(chosen.wavefronts, advance)
        if "filter" in chosen.parts:
            print("\n## Predictions of Kalman filters [nm rms]")
            filter_table(chosen.loop_frames, advance)
        if "coverage" in chosen.parts:
            print("\n## Positions within the ellipses of 95 %")
            coverage_table(chosen.frames, advance)


if __name__ == "__main__":
    main()
