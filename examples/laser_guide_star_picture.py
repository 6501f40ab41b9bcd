"""Draw a frame of a laser guide star, the sodium profile that is learnt from its mean, and the bound.

python examples/laser_guide_star_picture.py laser_guide_stars.png
"""

from __future__ import annotations

import sys

import laser_guide_stars as laser
import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

import faintspot as fs
from faintspot.slopes.training import fit_spot


def draw(path: str) -> None:
    """Draw a frame, the profile that is learnt from its mean, and the bound of every sub-aperture."""
    case = laser.CASES[1]
    star, flux = laser.star_of(case.fwhm_arcsec), 400.0
    profile, first = star.focused(case.profile), star.focused(laser.SINGLE.at(laser.ALTITUDES))
    narrow, mean = (
        laser.star_of(laser.NARROWEST_ARCSEC),
        laser.mean_of(star, profile, case.side, flux, laser.FRAMES_TO_LEARN, seed=7),
    )
    _, fit = fit_spot(mean, narrow, first, dark_variance_e2=laser.READ_NOISE_E**2)
    frames, _ = laser.frames_of(star.psf(profile), case.side, flux, 1, seed=3)
    sensor = np.full((laser.LENSLETS * case.side, laser.LENSLETS * case.side), np.nan)
    corners = (
        np.rint(laser.PLACES / (laser.DIAMETER_M / laser.LENSLETS) + (laser.LENSLETS - 1) / 2).astype(int)
        * case.side
    )
    for window, (x, y) in zip(np.split(frames[0], laser.N, axis=1), corners, strict=True):
        sensor[y : y + case.side, x : x + case.side] = window
    bound = fs.cramer_rao_covariance(flux, star.psf(profile), (case.side, case.side), detector=laser.DETECTOR)
    squares, axes = np.linalg.eigh(bound)
    figure = Figure((15, 4.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    reach = laser.DIAMETER_M / 2
    picture = left.imshow(sensor, origin="lower", extent=(-reach, reach, -reach, reach), cmap="cividis")
    left.set(title=f"frame, {flux:g} e- per sub-aperture", xlabel="x [m]", ylabel="y [m]")
    figure.colorbar(picture, ax=left, label="e-")
    for name, each, style in (
        ("true", profile, "k-"),
        ("learnt", fit.profile, "C1-"),
        ("start", first, "C7:"),
    ):
        middle.plot(each.altitudes_m / 1e3, 1e3 * each.density, style, label=name)
    middle.set(title="sodium profile", xlabel="altitude [km]", ylabel="return flux [1/km]")
    middle.legend()
    size = 4.0 * np.sqrt(squares)  # 0.1 px is drawn as 0.2 m
    angle = np.rad2deg(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    ellipses = EllipseCollection(
        size[:, 1],
        size[:, 0],
        angle,
        units="x",
        offsets=laser.PLACES,
        transOffset=right.transData,
        cmap="cividis",
    )
    ellipses.set_array(np.sqrt(squares[:, 1]))
    right.add_collection(ellipses)
    right.plot(*laser.LAUNCH_M, "r*", label="launch telescope")
    right.set(title="bound: one standard error", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    right.set(xlim=(-5.5, 4.5), ylim=(-4.5, 4.5))
    right.legend(loc="upper left")
    figure.colorbar(ellipses, ax=right, label="along the elongation [px]")
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    draw(sys.argv[1])
