"""faintspot layout: find the sub-apertures in a frame."""

import shlex
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import DoubtWarning, InputError
from faintspot.base.tables import save_tables
from faintspot.cli import layout_options
from faintspot.cli.commands import (
    KEY,
    NAMES,
    RANGES,
    Listed,
    SectionedCommand,
    declared,
    errors_of_options,
    option,
    suggested_slopes,
)
from faintspot.cli.layout_completing import (
    clearer_frame,
    completed,
    describe_grid,
    illuminated,
    measured_darks,
    with_measured_pixels,
)
from faintspot.cli.layout_options import describe, describe_settings, doubts_of, plain
from faintspot.cli.output import picture_file
from faintspot.io.frames import FrameSource, open_frames
from faintspot.slopes.camera.calibration import Calibration, binned
from faintspot.slopes.camera.frame_checks import MeanFrame, find_hot_pixels, misread, mosaic_contrast
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.recorded.first_settings import ASSUMED_NOISE_E, first_settings
from faintspot.slopes.recorded.survey import UsualFrames, survey
from faintspot.slopes.sensor.found_layout import FoundLayout, KnownGrid, find_layout
from faintspot.slopes.sensor.layout import GEOMETRIES, LARGEST_BIN, OPTICS, Layout

_MOST_FRAMES = 200  # averaged to find the spots
_FIRST_FRAMES = 20  # measured for the settings
_FEWEST_E = 10.0  # electrons of a spot that is seen in a single frame
_array = partial(option, section="Lenslet array")
_windows = partial(option, section="Windows")
_camera = partial(option, section="Camera")
_CALIBRATION = ("dark", "flat", "bad_pixels", "gain_e_per_adu", "read_noise_e")


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
    "lenslets are illuminated is searched for.",
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
    metavar="LIST",
    help="Sub-apertures to leave out, such as 3,17,40-45: their numbers in the picture drawn without this.",
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
    metavar="N",
    help="Measure in sums of N x N pixels, for windows over 64 px and colour mosaics; all results are in "
    "the camera's pixels.",
    show_default="1",
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
    exclude: list[int] | None,
    factor: int | None,
    mask_hot_pixels: bool,
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
    Spots of quad cells (2 x 2 pixels) overlap and cannot be found; --grid gives the array. A picture shows
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
      faintspot layout quad_cells.fits --grid 40x40 --dark dark.fits
    """
    target = Path(output)
    if accept or not frames:
        _accept(target, accept, frames)
        return
    keeps_settings = configuration.has(target, "settings") and not configuration.has(target, "layout")
    if target.exists() and not overwrite and not keeps_settings:
        raise InputError(f"{output}: already exists; --overwrite replaces its layout and settings")
    if options["pixels"] is not None and len(options["pixels"]) == 1:
        (options["pixels"],) = options["pixels"]
    optics = layout_options.optics(target, {name: options.pop(name) for name in OPTICS})
    of_camera = {name: options.pop(name) for name in _CALIBRATION}
    drawing = picture_file(target, picture, ".png")
    with open_frames(frames, key=key, time_axis=time_axis) as source:
        calibration = layout_options.calibration(target, of_camera)
        stated = layout_options.kept_calibration(calibration, of_camera)
        mean, first, saturation_adu, notes = _seen_frames(source, calibration)
        hot = find_hot_pixels(mean) if mask_hot_pixels else np.empty((0, 2), int)
        mean[tuple(hot.T)] = np.nan
        factor, shown = factor or 1, mean
        if grid is None:
            shown, unused = clearer_frame(mean, calibration)
            stated += unused
        if factor > 1:
            shown, options = binned(shown, factor).astype(np.float64), layout_options.binned(options, factor)
        found: FoundLayout | KnownGrid
        if grid is not None:
            found = illuminated(source.description, shown, grid, calibration, options)
        else:
            found = _found(source.description, shown, options)
        if factor > 1:
            found = found.magnified(factor, source.shape)
        kept = layout_options.kept(len(found.layout), exclude)
        if isinstance(found, FoundLayout):
            found = found[kept]
            layout = replace(found.layout, **optics, doubts=doubts_of(found))
        else:
            layout = replace(found.layout[kept], **optics, doubts=(found.doubt,) if found.doubt else ())
    calibration, lines = completed(calibration, found, layout, mean, hot)
    notes += lines
    if source.note:
        notes.append(f"  {source.description}: {source.note}")
    if calibration.saturation_adu is None and saturation_adu is not None:
        estimated = (*calibration.estimated, "saturation_adu")
        calibration = replace(calibration, saturation_adu=saturation_adu, estimated=estimated)
        notes.append(f"  saturation {saturation_adu:g} ADU, at which values pile up")
    unit = "ADU" if of_camera["gain_e_per_adu"] is None and calibration.gain_e_per_adu == 1.0 else "e-"
    seen = first_settings(layout, calibration, first)
    if unit == "ADU" and 0 < seen.flux < _FEWEST_E:
        likely = float(f"{(calibration.typical_read_noise_e or ASSUMED_NOISE_E) / seen.noise:.3g}")
        notes.append(f"  gain: 1 would leave {plain(seen.flux)} electrons of a spot; {likely:g} is assumed")
        estimated = (*calibration.estimated, "gain_e_per_adu")
        calibration = replace(calibration, gain_e_per_adu=likely, estimated=estimated)
        unit, seen = "e-", first_settings(layout, calibration, first)
    if (measured := measured_darks(of_camera["dark"])) is not None:
        keeps_noise = of_camera["read_noise_e"] is not None
        calibration, lines = with_measured_pixels(calibration, measured, keeps_noise=keeps_noise)
        notes += lines
    if isinstance(found, FoundLayout) and not seen.flux > 0:
        raise InputError(
            f"{source.description}: expected spots, found none in the {len(layout)} windows of the layout; "
            "average more frames, or look whether the frames are read right"
        )
    if calibration.read_noise_e is None and seen.noise > 0:
        noise = float(f"{seen.noise * calibration.em_gain:.3g}")
        estimated = (*calibration.estimated, "read_noise_e")
        calibration = replace(calibration, read_noise_e=noise, estimated=estimated)
    settings = Settings.load(target) if keeps_settings else seen.settings
    if seen.doubt and not keeps_settings:
        layout = replace(layout, doubts=(*layout.doubts, seen.doubt))
    if keeps_settings:
        notes.append(f"  the settings that {output} has are kept")
    marks: dict[str, Any] = {}
    if isinstance(found, FoundLayout):
        left_out = np.concatenate([found.outside, found.cut])
        marks = {"outside": left_out, "doubtful": found.clipped | found.unlike}
    if drawing is not None:
        from faintspot.slopes.sensor.drawing import layout_picture

        layout_picture(np.where(np.isnan(mean), np.nanmedian(mean), mean), layout, drawing, **marks)
    # The layout last: it may be long, and whatever is saved after it reads it again.
    if seen.psf is not None and not keeps_settings:
        save_tables(target, {"psf": seen.psf})
    for item in (settings, calibration, layout):
        configuration.save(target, item)
    if isinstance(found, KnownGrid):
        lines = describe_grid(output, found, layout, calibration)
    else:
        lines = describe(output, found, layout)
    for line in [*lines, *describe_settings(settings, layout, seen, unit), *stated, *notes]:
        click.echo(line)
    if unit == "ADU":
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


def _found(description: str, mean: NDArray[np.float64], options: Mapping[str, object]) -> FoundLayout:
    """Find the layout, and say in an error where, and which option changes it."""
    bad = np.isnan(mean)
    with errors_of_options(description):
        found = find_layout(np.where(bad, 0, mean), bad_pixels=bad, **options)
    grid = found.lenslets
    if (contrast := mosaic_contrast(mean, grid.spots, grid.pitch_px, grid.spot_px)) > 1:
        raise InputError(
            f"{description}: pixels of even and odd rows and columns differ by a factor of {contrast:.2g} in "
            "the spots, as in raw frames of a colour camera (Bayer mosaic); --bin 2 (bin = 2 in [layout]) "
            "sums them, --flat with a flat field in the same light corrects them"
        )
    return found


def _seen_frames(
    source: FrameSource, calibration: Calibration
) -> tuple[NDArray[np.float64], NDArray[np.generic], float | None, list[str]]:
    """Return the mean of the first usual frames [electrons], the first of them, their saturation, and notes.

    The mean is NaN where no frame is finite.
    """
    count = min(_MOST_FRAMES, source.n_frames)

    def blocks() -> Iterator[NDArray[np.generic]]:
        return (block for _, block in source.blocks(0, count, _FIRST_FRAMES))

    frames, notes = UsualFrames(), []
    seen = survey(source.shape, map(frames.seen, blocks()))
    unlike, repeated = frames.unlike, frames.repeated
    if (unlike | repeated).all():
        unlike, repeated = np.zeros((2, count), bool)
    usual = ~(unlike | repeated)
    if reason := misread(source.block(int(usual.argmax()), int(usual.argmax()) + 1)[0]):
        raise InputError(f"{source.description}: {reason}")
    mean = seen.mean
    if not usual.all():
        mean_frame, flags = MeanFrame(source.shape), iter(usual)
        for block in blocks():
            mean_frame.add(block[[next(flags) for _ in block]])
        mean = mean_frame.mean
    if unlike.any():
        notes.append(
            f"  {np.count_nonzero(unlike)} of {count} frames left out: at least twice as bright or half as "
            "bright as most, or with another background"
        )
    if again := int(np.count_nonzero(repeated & ~unlike)):
        notes.append(f"  {again} of {count} frames left out: repeated, the same as the one before")
    if np.isnan(mean).all():
        raise InputError(f"{source.description}: expected a frame with spots, every pixel is NaN or infinite")
    dark, electrons_per_adu = calibration.maps(source.shape)
    electrons: NDArray[np.float64] = (mean - dark) * electrons_per_adu
    chosen = np.flatnonzero(usual)[:_FIRST_FRAMES]
    first = source.block(int(chosen[0]), int(chosen[-1]) + 1)[chosen - chosen[0]]
    return electrons, first, seen.saturation_adu, notes
