"""Stated arrays, and calibrations completed by what frames show: illumination, background, hot pixels."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.statistics import MAD_TO_STD
from faintspot.cli import layout_options
from faintspot.cli.commands import errors_of_options, flag_of
from faintspot.cli.layout_options import is_number, plain
from faintspot.io.frames import open_frames
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.dark_frames import FEWEST_FRAMES, DarkPixels
from faintspot.slopes.camera.frame_checks import overlap, smooth_background, varies
from faintspot.slopes.camera.photon_transfer import measure_detector
from faintspot.slopes.sensor.found_layout import FoundLayout, KnownGrid, find_illuminated
from faintspot.slopes.sensor.layout import Layout

_QUAD_CELL = 2  # pixels on a side
_ONLY_WITHOUT = ("geometry", "pitch_px", "angle_deg", "centre", "fit", "move_windows")


def illuminated(
    description: str, mean: NDArray[np.float64], grid: str, calibration: Calibration, options: dict[str, Any]
) -> KnownGrid:
    """Return the illuminated sub-apertures of the grid; name the frame in an error."""
    wrong = [flag_of(name) for name in _ONLY_WITHOUT if options[name] not in (None, False, "auto", ())]
    if wrong:
        raise InputError(f"--grid, {', '.join(wrong)}: expected one of them; a grid fills the frame or --roi")
    shape = layout_options.grid_shape(grid)
    kept = {name: value for name, value in options.items() if name not in _ONLY_WITHOUT}
    with errors_of_options(description):
        return find_illuminated(mean, shape, has_dark=calibration.dark is not None, **kept)


def is_quad_cell(layout: Layout) -> bool:
    """Whether windows have two pixels on a side: every estimator is a difference of halves there."""
    return min(layout.window) == _QUAD_CELL


def describe_grid(output: str, found: KnownGrid, layout: Layout, calibration: Calibration) -> list[str]:
    """Describe which sub-apertures are illuminated."""
    height, width = layout.window
    lines = [
        f"{output}: {len(layout)} sub-apertures illuminated of {len(found.layout) + len(found.unlit)}, "
        f"pitch {layout.pitch_px:.4g} px, windows of {height} x {width} px"
    ]
    lines += layout_options.largest_window_note(layout)
    lines += [f"  doubtful: {doubt} (look at the picture)" for doubt in layout.doubts]
    if not is_quad_cell(layout):
        return lines
    lines.append(
        "  quad cells: the settings are the difference of halves over the flux, and no estimator improves "
        "it; its centroid gain follows the size of the spot (faintspot.slopes.training.measure_centroid_gain)"
    )
    if calibration.dark is None:
        lines.append(
            "  the dark level is not known: slopes come out too small where it is not 0; give --dark"
        )
    return lines


def completed(
    calibration: Calibration,
    found: FoundLayout | KnownGrid,
    layout: Layout,
    mean: NDArray[np.float64],
    hot: NDArray[np.int64],
) -> tuple[Calibration, list[str]]:
    """Add the frame's background as dark level where none is known, and hot pixels; describe them."""
    notes = []
    edges = layout.images(mean)[:, [0, -1]]
    if isinstance(found, KnownGrid) and (len(found.unlit) or is_quad_cell(layout)):
        edges = found.unlit if len(found.unlit) else np.zeros(1)
    adu_per_electron = calibration.em_gain / calibration.gain_e_per_adu
    level = float(np.nanmedian(edges)) * adu_per_electron
    spread = float(np.nanmedian(np.abs(edges - np.nanmedian(edges))))
    background = None
    if isinstance(found, FoundLayout):
        levels, background = _background(found, mean)
        if overlap(found.lenslets.pitch_px, found.lenslets.spot_px):
            level = float(np.median(levels)) * adu_per_electron
    if background is not None and calibration.dark is not None:
        low, high = np.quantile(background, [0.02, 0.98]) * adu_per_electron
        notes.append(
            f"  the background varies from {plain(low)} to {plain(high)} ADU beyond the dark, as reflections "
            "and haze do, and is not taken off; without a dark it is"
        )
    elif background is not None:
        estimated = (*calibration.estimated, "dark")
        dark = (background * adu_per_electron).astype(np.float32)
        calibration = replace(calibration, dark=dark, estimated=estimated)
        low, high = np.quantile(dark, [0.02, 0.98])
        notes.append(
            f"  dark {plain(low)} to {plain(high)} ADU, a map: the frame's background, which varies, as "
            "reflections and haze do; --dark gives the camera's own"
        )
    elif calibration.dark is None and level > spread > 0:
        estimated = (*calibration.estimated, "dark")
        calibration = replace(calibration, dark=float(f"{level:.7g}"), estimated=estimated)
        notes.append(
            f"  dark {calibration.dark:g} ADU, the frame's background; --dark gives the camera's own"
        )
    if len(hot):
        estimated = (*calibration.estimated, "bad_pixels")
        calibration = replace(calibration.with_bad_pixels(hot), estimated=estimated)
        notes.append(f"  {len(hot)} hot pixels masked")
    return calibration, notes


def _background(
    found: FoundLayout, mean: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return the background at each spot, and of all pixels, if it varies enough to change slopes."""
    grid = found.lenslets
    background = smooth_background(mean, grid.spots, grid.pitch_px, grid.spot_px)
    column, row = np.clip(np.rint(grid.spots).astype(int), 0, np.array(mean.shape[::-1]) - 1).T
    levels, flux = background[row, column], float(np.median(grid.flux))
    return levels, background if varies(mean, levels, flux, grid.pitch_px, grid.spot_px) else None


_MOST_NUMBERS = 1 << 27  # read at a time


def measured_darks(location: str | None) -> DarkPixels | None:
    """Return the pixels of a file of dark frames; None for a number, few frames, or frames with NaN."""
    if location is None or is_number(location):
        return None
    with open_frames([location]) as frames:
        most = _MOST_NUMBERS // (frames.shape[0] * frames.shape[1])
        if min(frames.n_frames, most) < FEWEST_FRAMES or min(frames.shape) < 4:
            return None
        darks = frames.block(0, min(frames.n_frames, most))
    return measure_detector(darks=darks).pixels if np.isfinite(darks).all() else None


def with_measured_pixels(
    calibration: Calibration, pixels: DarkPixels, *, keeps_noise: bool
) -> tuple[Calibration, list[str]]:
    """Return the calibration with the noise map and further bad pixels, and lines that describe them."""
    notes = []
    if not keeps_noise:
        electrons_per_adu = replace(calibration, bad_pixels=None).maps(pixels.noise_adu.shape)[1]
        noise = pixels.noise_adu * electrons_per_adu * calibration.em_gain
        calibration = replace(calibration, read_noise_e=noise)
        rms, median = calibration.typical_read_noise_e, float(np.nanmedian(calibration.read_noise_e))
        notes.append(f"  read noise of each pixel from the darks: median {median:.3g} e-, rms {rms:.3g} e-")
    found = np.concatenate([pixels.blinking, pixels.hot])
    if len(found):
        calibration = calibration.with_bad_pixels(found)
        notes.append(f"  {len(pixels.blinking)} pixels that blink and {len(pixels.hot)} hot ones masked")
    return calibration, notes


def clearer_frame(
    mean: NDArray[np.float64], calibration: Calibration
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the frame with or without the structure of its dark, whichever shows spots better.

    Spots are found above their own background, so that a dark helps only where it takes off a pattern. A
    noisy one, or one that was taken with light, adds one.

    Parameters
    ----------
    mean : (h, w) array
        Calibrated frame, NaN in bad pixels.
    calibration : Calibration

    Returns
    -------
    (h, w) array
    list of str
        A line on a dark that is not used.
    """
    if not isinstance(calibration.dark, np.ndarray):
        return mean, []
    dark, electrons_per_adu = calibration.maps((mean.shape[0], mean.shape[1]))
    without = mean + (dark - np.nanmedian(dark)) * electrons_per_adu
    if _roughness(mean) <= _roughness(without):
        return mean, []
    return without, [
        "  the sub-apertures were found without the dark, which adds noise or structure as large as spots"
    ]


def _roughness(image: NDArray[np.float64]) -> float:
    """Return the standard deviation of structures as large as spots, between these."""
    filled = np.where(np.isfinite(image), image, np.nanmedian(image))
    band = scipy.ndimage.gaussian_filter(filled, 1.0) - scipy.ndimage.gaussian_filter(filled, 4.0)
    return MAD_TO_STD * float(np.median(np.abs(band - np.median(band))))
