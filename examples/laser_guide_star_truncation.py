"""What do windows that cut off spots of a laser guide star do to slopes, on 8 m and at the size of an ELT?

Prints Markdown tables for groups of sub-apertures by the part of the flux that is cut off: slope of a spot at
its reference position and gain along the elongation, without noise, and the error of faint spots in units of
the Cramer-Rao bound. All methods know the profile; the centre of gravity has one width for all.

    python examples/laser_guide_star_truncation.py
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.estimators.built_in.correlation import Correlation

Floats = NDArray[np.float64]

PROFILE = fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], [0.6, 0.4])
EDGES = (0.0, 0.01, 0.05, 0.15, 0.3, 1.0)  # parts of the flux that are cut off
STEP_PX, REACH_PX = 0.3, 2.0
FLUX_E, READ_NOISE_E, FRAMES = 300.0, 1.0, 200


class Case(NamedTuple):
    """Telescope and sensor."""

    name: str
    diameter_m: float
    lenslets: int
    launch_m: float
    pixel_arcsec: float
    window_px: int
    every: int
    """Of so many sub-apertures one is looked at."""
    width_px: float
    """Of the window of the centre of gravity."""


CASES = (
    Case("8 m, 20 x 20, launched 5 m off-axis", 8.0, 20, -5.0, 0.5, 10, 2, 5.0),
    Case("8 m, 20 x 20, launched 5 m off-axis", 8.0, 20, -5.0, 0.5, 6, 2, 5.0),
    Case("39 m, 80 x 80, launched 40 m off-axis", 39.0, 80, -40.0, 1.0, 16, 31, 16.0),
    Case("39 m, 80 x 80, launched 40 m off-axis", 39.0, 80, -40.0, 1.0, 10, 31, 16.0),
)


def star_of(case: Case) -> fs.LaserGuideStar:
    """Return the star as some of the sub-apertures see it."""
    line = (np.arange(case.lenslets) - (case.lenslets - 1) / 2) * case.diameter_m / case.lenslets
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    lit = np.hypot(x, y) < case.diameter_m / 2
    places = np.column_stack([x, y])[lit][:: case.every]
    spot = fs.PSF.analytic("gaussian", size=1.2 / case.pixel_arcsec / 2, radius_px=8)
    return fs.LaserGuideStar(places, [case.launch_m, 0.0], case.pixel_arcsec, spot, 30.0, 2600.0)


def pipelines(layout: fs.Layout, psf: fs.PSF, width_px: float) -> dict[str, fs.SlopePipeline]:
    """Return the methods; spots are within 2 px of the reference."""
    calibration = fs.Calibration(read_noise_e=READ_NOISE_E)
    noise = {"flux_e": FLUX_E, "read_noise_e": READ_NOISE_E}
    weights = fs.FixedWeights.matched(psf, layout.window, **noise)
    window = fs.Settings("window", window_fwhm_px=width_px, spot_fwhm_px=width_px, normalisation="frame")
    ml = fs.Settings("ml", search_range_px=REACH_PX)
    correlation = fs.Settings(Correlation(step_px=0.5), search_range_px=REACH_PX)
    return {
        "weighted centre of gravity": fs.SlopePipeline(layout, window, calibration),
        "correlation": fs.SlopePipeline(layout, correlation, calibration, psf=psf),
        "linear matched filter": fs.SlopePipeline(layout, window, calibration, score=weights),
        "ml": fs.SlopePipeline(layout, ml, calibration, psf=psf),
    }


def table(case: Case) -> None:
    """Print the table of a case."""
    star = star_of(case)
    profile, side = star.focused(PROFILE), case.window_px
    along = star.elongation_px(profile)
    length = np.hypot(*along.T)
    along = along / length[:, None]
    layout = fs.Layout.grid((1, len(star)), pixels=side)

    def frame(step: float) -> Floats:
        images = np.maximum(star.images(profile, (side, side), step * along), 0.0)
        return images.swapaxes(0, 1).reshape(side, -1)

    psf = star.psf(profile, radius_px=side / 2 + 3)
    lost = 1.0 - layout.images(frame(0.0)).sum(axis=(1, 2))
    groups = np.digitize(lost, EDGES[1:-1])
    drawn = np.random.default_rng(1).poisson(FLUX_E * frame(0.0), (FRAMES, side, side * len(star)))
    noisy = drawn + np.random.default_rng(2).normal(0.0, READ_NOISE_E, drawn.shape)
    bound = fs.cramer_rao_covariance(
        FLUX_E, psf, (side, side), detector=fs.slopes.simulate.Detector(READ_NOISE_E)
    )
    least = np.sqrt(np.trace(bound, axis1=1, axis2=2))
    print(f"\n### {case.name}, {side} px of {case.pixel_arcsec:g} arcsec\n")
    print(f"Spots of two layers, {length.min():.1f} to {length.max():.1f} px long.\n")
    shown = [group for group in range(len(EDGES) - 1) if np.any(groups == group)]
    print(
        "| slope at the reference [px rms]; gain; error / bound | "
        + " | ".join(f"{100 * EDGES[group]:g} to {100 * EDGES[group + 1]:g} % cut off" for group in shown)
        + " |"
    )
    print("|---" * (1 + len(shown)) + "|")
    for name, pipeline in pipelines(layout, psf, case.width_px).items():
        ahead, behind = (pipeline(1e4 * frame(step)) for step in (STEP_PX, -STEP_PX))
        seen = [(np.stack([each.x, each.y], axis=1) * along).sum(axis=1) for each in (ahead, behind)]
        offset, gain = 0.5 * (seen[0] + seen[1]), (seen[0] - seen[1]) / (2 * STEP_PX)
        found = pipeline(noisy)
        error = np.sqrt(found.x.var(axis=0) + found.y.var(axis=0)) / np.maximum(gain, 0.1) / least
        cells = [
            f"{np.sqrt(np.square(offset[groups == group]).mean()):.3f}; {gain[groups == group].mean():.2f}; "
            f"{np.median(error[groups == group]):.2f}"
            for group in shown
        ]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    for each in CASES:
        table(each)
