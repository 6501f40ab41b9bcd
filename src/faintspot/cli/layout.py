"""faintspot layout: find the sub-apertures in a frame."""

import math
import shlex
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from faintspot.base.errors import DoubtWarning, InputError
from faintspot.base.tables import is_map, save_tables
from faintspot.cli.commands import (
    KEY,
    NAMES,
    RANGES,
    Listed,
    SectionedCommand,
    declared,
    errors_of_options,
    flag_of,
    option,
    suggested_slopes,
)
from faintspot.cli.output import picture_file
from faintspot.io.frames import open_frames
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.recorded.first_layout import (
    FirstLayout,
    first_layout,
    is_quad_cell,
    plain,
    stated_calibration,
    stated_optics,
)
from faintspot.slopes.recorded.first_settings import FirstSettings
from faintspot.slopes.sensor.detection.fits import MOST
from faintspot.slopes.sensor.found_layout import FoundLayout
from faintspot.slopes.sensor.layout import GEOMETRIES, LARGEST_BIN, OPTICS, Layout
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, removed_terms

_array = partial(option, section="Lenslet array")
_windows = partial(option, section="Windows")
_camera = partial(option, section="Camera")
_CALIBRATION = ("dark", "flat", "bad_pixels", "gain_e_per_adu", "read_noise_e")
_ONLY_WITHOUT = ("geometry", "pitch_px", "angle_deg", "centre", "fit", "move_windows")  # a grid
_LARGE_PX = 0.03  # constant error at the pupil's edge


@click.command(cls=SectionedCommand)
@click.argument("frames", nargs=-1, metavar="FRAME...")
@_array("--geometry", type=click.Choice(["auto", *GEOMETRIES]), default="auto", help="Packing.")
@_array("--pitch-px", type=float, metavar="PX", help="Distance of neighbouring lenslets, used as stated.")
@_array(
    "--angle-deg", type=float, metavar="DEG", help="Angle of the rows from +x towards +y, used as stated."
)
@_array(
    "--centre",
    type=Listed(float, (2,), "X,Y in pixels"),
    metavar="X,Y",
    help="Point of the lattice [px], used as stated: the middle of a lenslet, of an edge, or a corner.",
)
@_array(
    "--fit",
    type=NAMES,
    default=(),
    metavar="LIST",
    help="Which of pitch, angle, centre to fit to the frame although stated, such as pitch,angle.",
    show_default="those not stated",
)
@_array(
    "--grid",
    metavar="ROWSxCOLUMNS",
    help="Rows and columns of an array that fills the frame or --roi, such as quad cells; then only which "
    "lenslets are illuminated is searched for. Up to 4x4 spots may be anywhere.",
)
@_array(
    "--roi",
    type=Listed(float, (4,), "X0,Y0,X1,Y1 in pixels"),
    metavar="X0,Y0,X1,Y1",
    help="Look only at columns X0 to X1 - 1 and rows Y0 to Y1 - 1 of the frame.",
)
@_array(
    "--illuminated-fraction",
    type=float,
    metavar="PART",
    help="Least flux of an illuminated lenslet, as a part of the median.",
    show_default="where fewest are, 0.18 to 0.5; with --grid 0.3",
)
@_array(
    "--pupil",
    type=Listed(float, (3, 4), "X,Y,R or X,Y,R,INNER in pixels"),
    metavar="X,Y,R[,INNER]",
    help="Centre and radius [px] of the disk, or annulus, whose lenslets are taken, illuminated or not.",
)
@_array(
    "--exclude",
    type=RANGES,
    default=(),
    metavar="LIST",
    help="Sub-apertures to leave out, such as 3,17,40-45: their numbers in the picture drawn without this.",
    show_default="none",
)
@_windows(
    "--pixels",
    type=Listed(float, (1, 2), "a number of pixels, or height and width, such as 12,16"),
    metavar="N|NY,NX",
    help="Side of a window, or its height and width [px].",
    show_default="the largest without overlap",
)
@_windows(
    "--bin",
    "factor",
    type=click.IntRange(1, LARGEST_BIN),
    default=1,
    metavar="N",
    help="Measure in sums of N x N pixels, for windows over 64 px and colour mosaics; all results are in "
    "the camera's pixels.",
)
@_windows(
    "--move-windows",
    is_flag=True,
    help="Move all windows alike, off their spots, to keep lenslets at the frame's edge.",
)
@_camera(
    "--dark",
    metavar="FILE|ADU",
    help="Dark frame, or several (averaged), as FILE[:ARRAY], or a number of ADU. From 10 frames on, the "
    "read noise of each pixel is measured, and pixels that blink or are hot are masked.",
)
@_camera("--flat", metavar="FILE", help="Flat field, or several (averaged), divided by its mean.")
@_camera(
    "--bad-pixels", metavar="FILE", help="Map that is not 0 where a pixel is bad, or rows of row, column."
)
@_camera(
    "--mask-hot-pixels",
    is_flag=True,
    help="Enter isolated bright pixels and pairs as bad pixels. Not for spots sharper than Nyquist sampling.",
)
@declared(Calibration, "gain_e_per_adu", sections="Camera", show_default="1, frames in electrons")
@_camera(
    "--read-noise-e", metavar="E|FILE", help="Read noise, a number or a map of each pixel as FILE[:ARRAY]."
)
@declared(Layout, *OPTICS, sections="Telescope")
@KEY
@option("--accept", is_flag=True, help="Settle the doubts of the layout that --output has; without FRAME.")
@option("--output", "-o", metavar="TOML", default="faintspot.toml", help="Configuration to write.")
@option(
    "--picture", metavar="PNG", help="Picture of frame and grid to write.", show_default="beside the output"
)
@option(
    "--overwrite",
    is_flag=True,
    help="Replace the layout and settings of an existing configuration; its calibration stays.",
)
def command(
    frames: tuple[str, ...],
    output: str,
    picture: str | None,
    grid: str | None,
    key: str | None,
    time_axis: int | None,
    overwrite: bool,
    accept: bool,
    **options: Any,
) -> None:
    """Find the sub-apertures in a frame and write a configuration.

    FRAME is a file with spots, from one frame to many of the same field (the first 200 are averaged). Square
    and hexagonal lenslet arrays are found without hints: pitch, angle, offset, and which lenslets are
    illuminated.
    Spots of quad cells (2 x 2 pixels) overlap and cannot be found; --grid gives the array, and settles
    doubts about sensors of few spots. A picture shows
    the frame with the windows that were found: look at it. --illuminated-fraction, --pupil, --exclude correct
    it.

    A configuration with settings but no layout, as `faintspot tune` writes it without frames, keeps them.
    Else the settings written beside the layout are a start: a centre of gravity under a weight that follows
    the spot, or under a fixed window where the flux is too low for that. They suit the noise, flux, spot
    width and displacements of the first 20 frames, which must be typical of the frames to come.
    `faintspot tune` finds better ones.

    \b
    Examples:
      faintspot layout flat_wavefront.fits -o faintspot.toml
      faintspot layout cube.npz --dark dark.fits --gain-e-per-adu 1.9 --pixels 16
      faintspot layout eye.fits --pupil 512,498,320,40 --exclude 0-3,57
      faintspot layout large_windows.tif --bin 2
      faintspot layout tip_tilt.fits --grid 2x2
      faintspot layout quad_cells.fits --grid 40x40 --dark dark.fits
    """
    target = Path(output)
    if accept or not frames:
        _accept(target, accept, frames)
        return
    keeps_settings = configuration.has(target, "settings") and not configuration.has(target, "layout")
    if target.exists() and not overwrite and not keeps_settings:
        raise InputError(f"{output}: already exists; --overwrite replaces its layout and settings")
    optics = stated_optics(target, {name: options.pop(name) for name in OPTICS})
    given = {name: options.pop(name) for name in _CALIBRATION}
    drawing = picture_file(target, picture, ".png")
    if grid is not None:
        options = _options_of_grid(grid, options)
    with open_frames(frames, key=key, time_axis=time_axis) as source:
        calibration = stated_calibration(target, given)
        with errors_of_options(""):
            found = first_layout(source, calibration, given, optics=optics, **options)
    settings = found.seen.settings
    if keeps_settings:
        settings = Settings.load(target)
        found.notes.append(f"the settings that {output} has are kept")
    elif found.seen.doubt:
        found.layout = replace(found.layout, doubts=(*found.layout.doubts, found.seen.doubt))
    if drawing is not None:
        _draw(found, drawing)
    # The layout last: it may be long, and whatever is saved after it reads it again.
    if found.seen.psf is not None and not keeps_settings:
        save_tables(target, {"psf": found.seen.psf})
    for item in (settings, found.calibration, found.layout):
        configuration.save(target, item)
    summary, *lines = describe(found, settings)
    click.echo(f"{output}: {summary}")
    for line in [*lines, *_kept_calibration(calibration, given), *found.notes]:
        click.echo(f"  {line}")
    if found.unit == "ADU":
        click.echo(
            "  gain unknown (--gain-e-per-adu): these settings do not depend on it, standard errors do"
        )
    if drawing is not None:
        click.echo(f"  picture: {drawing}")
    arguments = [*frames, *(["--key", key] if key else [])]
    arguments += [] if time_axis is None else ["--time-axis", str(time_axis)]
    arguments += ["--config", output, "-o", suggested_slopes()]
    click.echo(f"Next: faintspot slopes {shlex.join(arguments)}")


def _accept(target: Path, accept: bool, frames: tuple[str, ...]) -> None:
    """Settle the doubts of a layout."""
    if frames or not accept:
        raise InputError("FRAME, --accept: expected frames to find the sub-apertures in, or --accept without")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)
        layout = Layout.load(target)
    configuration.save(target, replace(layout, doubts=()))
    click.echo(f"{target}: {'accepted: ' + '; '.join(layout.doubts) if layout.doubts else 'no doubts'}")


def _options_of_grid(text: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that go with an array such as 7x7, which fills the frame."""
    rows, _, columns = text.lower().partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and int(rows) * int(columns) > 0):
        raise InputError(f"--grid {text}: expected rows and columns of lenslets, such as 7x7")
    if max(int(rows), int(columns)) <= MOST:
        return {**options, "grid": (int(rows), int(columns))}
    wrong = [flag_of(name) for name in _ONLY_WITHOUT if options[name] not in (None, False, "auto", ())]
    if wrong:
        raise InputError(f"--grid, {', '.join(wrong)}: expected one of them; a grid fills the frame or --roi")
    kept = {name: value for name, value in options.items() if name not in _ONLY_WITHOUT}
    return {**kept, "grid": (int(rows), int(columns))}


def _draw(first: FirstLayout, path: Path) -> None:
    """Write the picture of the frame and the windows."""
    from faintspot.slopes.sensor.drawing import layout_picture

    marks: dict[str, Any] = {}
    if isinstance(first.found, FoundLayout):
        left_out = np.concatenate([first.found.outside, first.found.cut])
        marks = {"outside": left_out, "doubtful": first.found.clipped | first.found.unlike}
    frame = np.where(np.isnan(first.mean), np.nanmedian(first.mean), first.mean)
    layout_picture(frame, first.layout, path, **marks)


def describe(first: FirstLayout, settings: Settings) -> list[str]:
    """Describe the sub-apertures, those left out, and the settings, a line each."""
    layout, found, seen, unit = first.layout, first.found, first.seen, first.unit
    rows, columns = np.ptp(layout.cells, axis=0) + 1
    height, width = layout.window
    lines = [
        f"{len(layout)} sub-apertures lit of a {layout.geometry} array of {rows} x {columns}, pitch "
        f"{layout.pitch_px:.2f} px, angle {layout.angle_deg:.2f} deg, windows of {height} x {width} px"
    ]
    side, most = max(layout.window), LARGEST_WINDOW * layout.bin
    if side >= most and layout.pitch_px is not None and layout.pitch_px >= side + 1:
        lines.append(
            f"windows stop at {most} px, of a pitch of {layout.pitch_px:.0f} px: spots farther than "
            f"{most // 2} px from their centre are missed; --bin {layout.bin + 1} allows larger ones"
        )
    lines += [f"doubtful: {doubt}" for doubt in layout.doubts]
    if found.doubts:
        lines.append("(see the picture; try --pitch-px, --grid, --pupil)")
    if isinstance(found, FoundLayout):
        lines += _left_out(found, layout)
    elif is_quad_cell(layout):
        lines.append(
            "quad cells: the settings are the difference of halves over the flux, and no estimator improves "
            "it; its centroid gain follows the size of the spot "
            "(faintspot.slopes.training.measure_centroid_gain)"
        )
        if first.calibration.dark is None:
            lines.append("the dark level is not known: slopes are too small where it is not 0; give --dark")
    estimator, reach = settings.estimator, settings.search_range_px
    within = "" if reach is None else f", slopes within {np.max(reach):g} px"
    lines.append(f"background noise {plain(seen.noise)} {unit}, flux of a spot {plain(seen.flux)} {unit}")
    lines.append(f"{estimator.name}: {estimator.in_words(len(layout), layout.pixels)}{within}")
    return lines + _limits(seen)


def _left_out(found: FoundLayout, layout: Layout) -> list[str]:
    """Describe spots that are in no window, or far from their lattice or window."""
    lines = []
    if len(found.cut):
        lines.append(
            f"{len(found.cut)} lit lenslets at the frame's edge left out, their windows do not fit; smaller "
            "windows (--pixels) or --move-windows take more"
        )
    if len(found.outside):
        lines.append(
            f"lit spots outside all windows: {len(found.outside)}, see the circles in the picture; a smaller "
            "--illuminated-fraction takes dim lenslets"
        )
    if (drift := np.linalg.norm(found.lenslets.drifts, axis=1).max()) > 0:
        lines.append(
            f"the windows follow spots that lie up to {drift:.1f} px from the regular lattice, which stays "
            "the reference"
        )
    if layout.fitted:
        lines.append(
            "the reference is the lattice fitted to this frame: slopes lack its "
            f"{removed_terms(layout.fitted)}; --pitch-px, --angle-deg, --centre here, or slopes --reference "
            "flat.npz, keep them"
        )
    moved = np.abs(np.median(layout.offsets, axis=0))
    if moved.max() > layout.bin:
        lines.append(
            f"windows moved off the spots by ({moved[0]:.1f}, {moved[1]:.1f}) px: "
            "centres of gravity are worse in them"
        )
    return lines


def _limits(seen: FirstSettings) -> list[str]:
    """Describe what the settings do not reach."""
    lines = []
    if seen.response < 1:
        lines.append(
            f"the flux of single frames is too low for full slopes: they show {seen.response:.2f} of the "
            "displacements; `faintspot tune --recording` says what is possible"
        )
    if seen.systematic_px is not None and math.isfinite(seen.systematic_px):
        lines.append(
            f"S-curve: systematic errors up to {max(seen.systematic_px, 0.001):.3f} px wherever a spot of "
            f"{seen.fwhm_px:.2g} px lies in its pixels, in simulations of Gaussian spots"
        )
    if seen.at_edge_px > _LARGE_PX:
        lines.append(
            "spots overlap: where neighbours are missing, slopes are off by up to "
            f"{plain(seen.at_edge_px)} px, the same in all frames; a reference of the same spots takes it off"
        )
    return lines


def _kept_calibration(calibration: Calibration, given: Mapping[str, object]) -> list[str]:
    """Return a line on what an existing configuration states and was not given now."""
    kept = [
        f"{name} {'map' if is_map(getattr(calibration, name)) else plain(value)}"
        for name, value in calibration.to_table().items()
        if given.get(name) is None
    ]
    return [f"kept as the configuration states: {', '.join(kept)}"] if kept else []
