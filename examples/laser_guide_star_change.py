"""Which modes does a sodium layer leave that changes, if its profile is followed, and if it is not?

Prints a Markdown table for the telescope of `laser_guide_stars.py`: wavefront error of Zernike modes 5 to 11
against time, with the loop closed on each method's slopes.

    python examples/laser_guide_star_change.py
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import laser_guide_stars as laser
import numpy as np
from laser_guide_stars import ALTITUDES, CALIBRATION, MATRIX, READ_NOISE_E, Advance, Floats, N, star_of

import faintspot as fs
from faintspot.cli.shared.progress import progress_bar
from faintspot.slopes.estimators.built_in.correlation import Correlation
from faintspot.slopes.training import MeanImages, fit_sodium_profile, fit_spot

CHANGE_FLUX_E, RATE_HZ, SECONDS, STEP_S = 200.0, 1000, 70, 2
APPEARS_S = (10.0, 40.0)
TIME_CONSTANT_S = 4.0
CHANGE_SIDE = 10
CORRECTED = 36  # highest Zernike mode that the loop corrects


def layer_at(star: fs.LaserGuideStar, time_s: float) -> fs.SodiumProfile:
    """Return a layer in which a second peak appears above the first within half a minute."""
    part = float(np.interp(time_s, APPEARS_S, (0.0, 0.45)))
    layers = [(1 - part) * fs.SodiumProfile.gaussian(88e3, 8e3).at(ALTITUDES).density]
    layers.append(part * fs.SodiumProfile.gaussian(96e3, 3e3).at(ALTITUDES).density)
    return star.focused(fs.SodiumProfile(ALTITUDES, layers[0] + layers[1]))


def corrected_modes(slopes: Floats) -> Floats:
    """Return what the loop sees of mean slopes (N, 2): Zernike modes 2 to `CORRECTED` [nm]."""
    return (MATRIX @ slopes.T.ravel())[: CORRECTED - 1]


SLOPES_OF_MODES = np.linalg.pinv(MATRIX)[:, : CORRECTED - 1]


def change_table(advance: Advance) -> None:
    """Print the modes that a changing layer leaves, with the loop closed on each method's slopes."""
    star, side, window = star_of(1.2), CHANGE_SIDE, (CHANGE_SIDE, CHANGE_SIDE)
    first = layer_at(star, 0.0)
    mean = laser.mean_of(star, first, side, CHANGE_FLUX_E, 10 * RATE_HZ, seed=1)
    begun = laser.SINGLE.at(ALTITUDES)
    sensor, fit = fit_spot(mean, star_of(laser.NARROWEST_ARCSEC), begun, dark_variance_e2=READ_NOISE_E**2)
    psf = sensor.psf(fit.profile, radius_px=side / 2 + 3)
    noise = {"flux_e": CHANGE_FLUX_E, "read_noise_e": READ_NOISE_E}
    layout = laser.layout_of(side)

    def linear(own: fs.PSF) -> fs.SlopePipeline:
        weights = fs.FixedWeights.matched(own, window, **noise)
        settings = fs.Settings("window", flux_e=CHANGE_FLUX_E)
        return fs.SlopePipeline(layout, settings, CALIBRATION, score=weights)

    def fitted(own: fs.PSF) -> fs.SlopePipeline:
        settings = fs.Settings("ml", search_range_px=2.0)
        return fs.SlopePipeline(layout, settings, CALIBRATION, psf=own)

    gaussian = fs.Settings("window", flux_e=CHANGE_FLUX_E, window_fwhm_px=5.0)
    correlation = fs.Settings(Correlation(step_px=0.5), search_range_px=2.0)
    makers: dict[str, tuple[Any, bool]] = {
        "weighted centre of gravity, static": (
            lambda own: fs.SlopePipeline(layout, gaussian, CALIBRATION, psf=own),
            False,
        ),
        "correlation, static": (
            lambda own: fs.SlopePipeline(layout, correlation, CALIBRATION, psf=own),
            False,
        ),
        "matched filter, static": (linear, False),
        "matched filter, followed": (linear, True),
        "ml, static": (fitted, False),
        "ml, followed": (fitted, True),
    }
    print("\n| method | " + " | ".join(f"{t} s" for t in range(0, SECONDS + 1, 10)), end=" | ")
    print("largest, 5 to 11 | largest defocus |")
    print("|---" * (4 + SECONDS // 10) + "|")
    for name, (maker, follows) in makers.items():
        history = _followed(star, sensor, fit.profile, maker, maker(psf), follows, side, mean)
        advance(1)
        away = np.sqrt(np.square(history[:, 3:10]).sum(axis=1))
        cells = [f"{value:.1f}" for value in away[:: 10 // STEP_S]]
        largest = f"{away.max():.1f} | {np.abs(history[:, 2]).max():.1f}"
        print(f"| {name} | " + " | ".join(cells) + f" | {largest} |", flush=True)


def _followed(
    star: fs.LaserGuideStar, sensor: fs.LaserGuideStar, profile: fs.SodiumProfile, maker: Any,
    pipeline: fs.SlopePipeline, follows: bool, side: int, mean: MeanImages,
) -> Floats:  # fmt: skip
    """Return Zernike modes 2 to `CORRECTED` of the wavefront [nm] against time, of a method's loop."""
    mean = replace(mean, time_constant_frames=TIME_CONSTANT_S * RATE_HZ)
    moving = replace(star, spot=star.spot.blurred(laser.MOTION_PX))
    modes = np.zeros(CORRECTED - 1)
    history, zero = [], np.zeros((N, 2))
    for step in range(SECONDS // STEP_S + 1):
        layer = layer_at(star, step * STEP_S)
        for _ in range(2):  # the loop settles in far less than a step
            positions = (SLOPES_OF_MODES @ modes).reshape(2, N).T
            images = CHANGE_FLUX_E * moving.images(layer, (side, side), positions)
            slopes = pipeline(images.swapaxes(0, 1).reshape(side, -1))
            seen = np.stack([slopes.x, slopes.y], axis=1)
            if step == 0:  # references calibrated on the first layer
                zero = seen - positions
            modes = modes - corrected_modes(seen - zero)
        history.append(modes)
        if follows:
            drawn = laser.mean_of(star, layer, side, CHANGE_FLUX_E, STEP_S * RATE_HZ, 100 + step, positions)
            mean = mean.updated(drawn.images_e, drawn.slopes_px, frames=drawn.frames)
            profile = fit_sodium_profile(mean, sensor, profile, dark_variance_e2=READ_NOISE_E**2).profile
            pipeline, zero = maker(sensor.psf(profile, radius_px=side / 2 + 3)), np.zeros((N, 2))
    return np.array(history)


def main() -> None:
    """Print the table."""
    done = 0
    with progress_bar("Laser guide stars", "methods") as show:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            show(done, 6)

        change_table(advance)


if __name__ == "__main__":
    main()
