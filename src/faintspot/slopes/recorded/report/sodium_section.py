"""Section of a report page that shows sodium profiles."""

from __future__ import annotations

from collections.abc import Mapping

from faintspot.base.errors import InputError
from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Section
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.io.frames import FrameSource
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.recorded.sodium import sodium_of_frames
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.laser_spots import LaserSpots
from faintspot.slopes.spots.sodium import SodiumProfile

_TEXT = Texts("faintspot.slopes.recorded")


def profile_figure(profiles: Mapping[str, SodiumProfile]) -> FigureWithData:
    """Draw the density of profiles against altitude; the last one is emphasised."""
    *before, newest = profiles
    lines, rows = [], []
    for index, (name, profile) in enumerate(profiles.items()):
        altitude, density = profile.altitudes_m / 1e3, 1e3 * profile.density
        style: dict[str, object] = {"color": METHOD_COLOURS[1], "lw": 2.2}
        if name != newest:
            dashes = ("--", ":", "-.")[index % 3] if len(before) > 1 else "--"
            style = {"color": GREY, "lw": 1.6, "ls": dashes}
        mean = f"mean {profile.mean_m / 1e3:.1f} km, std {profile.std_m / 1e3:.1f} km"
        lines.append(Line(f"{name}\n({mean})", density, altitude, style=style))
        rows += [(name, f"{a:.6g}", f"{b:.6g}") for a, b in zip(altitude, density, strict=True)]
    flux, height = "return flux per km of altitude", "altitude above sea level (km)"
    panel = Panel(lines, flux, height, x_range=(0, None), legend=True)
    return _TEXT.figure("sodium", plot([[panel]], 4.6, width=0.6 * WIDTH, legend=""), rows)


def sodium_section_of_frames(
    source: FrameSource, layout: Layout, calibration: Calibration, laser: LaserSpots, most_frames: int
) -> Section:
    """Return the section with the configured profile, and that of frames; or why there is none."""
    try:
        found = sodium_of_frames(source, layout, calibration, laser, most_frames=most_frames)
    except InputError as error:
        return _TEXT.section("sodium", missing=f"Not fitted: {error}.")
    sodium = found.sodium
    profiles = {"configured": sodium.star.focused(laser.profile), "these frames": sodium.fit.profile}
    figure = profile_figure(profiles)
    doubt = found.left_out.capitalize() or None
    return _TEXT.section("sodium", figure, width=sodium.spot_fwhm_arcsec, left_out=doubt)
