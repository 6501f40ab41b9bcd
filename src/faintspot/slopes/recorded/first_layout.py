"""Layout, calibration and settings to begin with, from frames of spots."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError, errors_within
from faintspot.base.statistics import FWHM_TO_STD, mad_std
from faintspot.base.tables import Tables
from faintspot.io.frames import FrameSource, open_frames
from faintspot.slopes.camera.calibration import Calibration, binned, read_map
from faintspot.slopes.camera.dark_frames import FEWEST_FRAMES
from faintspot.slopes.camera.frame_checks import MeanFrame, find_hot_pixels, misread, mosaic_contrast
from faintspot.slopes.camera.photon_transfer import measure_detector
from faintspot.slopes.recorded.first_settings import ASSUMED_NOISE_E, WIDEST_PX, FirstSettings, first_settings
from faintspot.slopes.recorded.survey import UsualFrames, survey
from faintspot.slopes.sensor.background import (
    least_difference,
    lenslet_background,
    overlap,
    values_at,
    varies,
)
from faintspot.slopes.sensor.binning import scaled_points
from faintspot.slopes.sensor.found_layout import FoundLayout, KnownGrid, find_grid, find_layout
from faintspot.slopes.sensor.layout import OPTICS, Layout
from faintspot.slopes.sensor.region import neighbour_vectors
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, window_size

_MOST_FRAMES = 200  # averaged to find the spots
_FIRST_FRAMES = 20  # measured for the settings
_FEWEST_E = 10.0  # electrons of a spot that is seen in a single frame
_MOST_NUMBERS = 1 << 27  # of dark frames, read at a time
_MOST_LEVELS = (0.02, 0.98)  # quantiles between which a background varies
_QUAD_CELL = 2  # pixels on a side
_LEVELS = ("dark", "read_noise_e")  # numbers or maps


@dataclass
class FirstLayout:
    """Layout, calibration and settings that frames show.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
        As stated, completed by what the frames show.
    seen : FirstSettings
    found : FoundLayout or KnownGrid
        Sub-apertures that were found, without those excluded.
    mean : (h, w) array
        Mean of the usual frames [electrons]; NaN in bad pixels.
    unit : str
        Unit of the frames: "e-" if their gain is stated or estimated, otherwise "ADU".
    notes : list of str
        What was left out or estimated, a line each.
    """

    layout: Layout
    calibration: Calibration
    seen: FirstSettings
    found: FoundLayout | KnownGrid
    mean: Floats
    unit: str
    notes: list[str]


def stated_calibration(path: Path, given: Mapping[str, Any]) -> Calibration:
    """Return the calibration that a configuration states, with what is given now (None: nothing).

    Values are numbers, or texts: a number or the file of a map. What was estimated from earlier frames is
    left out, to be estimated again.
    """
    known, defaults = Calibration.load(path) if path.exists() else Calibration(), Calibration()
    changes: dict[str, Any] = {name: getattr(defaults, name) for name in known.estimated}
    for name, value in given.items():
        if isinstance(value, str):
            changes[name] = float(value) if name in _LEVELS and is_number(value) else read_map(name, value)
        elif value is not None:
            changes[name] = value
    if given.get("flat") is not None:
        flat = changes["flat"]
        usable = np.isfinite(flat) & (flat > 0)
        if not usable.any():
            raise InputError(f"{given['flat']}: expected a flat field, no pixel is above 0")
        changes["flat"] = flat / flat[usable].mean()
    return replace(known, **changes, estimated=())


def is_number(text: str) -> bool:
    """Return whether a value is a number; otherwise it names a file."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def stated_optics(path: Path, given: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the scales of a layout that are given, or else those that a configuration has."""
    known = Tables(path).tables.get("layout", {}) if path.exists() else {}
    return {name: known.get(name) if given[name] is None else given[name] for name in OPTICS}


def plain(value: object) -> str:
    """Format a number to three digits, never as 6.7e+02; return other values unchanged."""
    if not isinstance(value, float | int):
        return str(value)
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


def first_layout(
    source: FrameSource,
    calibration: Calibration,
    given: Mapping[str, Any],
    *,
    optics: Mapping[str, Any],
    grid: tuple[int, int] | None = None,
    factor: int = 1,
    exclude: Sequence[int] = (),
    mask_hot_pixels: bool = False,
    **options: Any,
) -> FirstLayout:
    """Find the sub-apertures of frames, complete the calibration, and choose settings.

    Parameters
    ----------
    source : FrameSource
        Frames of the same field, of which the first 200 are averaged.
    calibration : Calibration
        What is known of the camera.
    given : mapping
        Values that the calibration takes from `stated_calibration`. A file of ten dark frames or more gives
        the noise of each pixel, if no read noise is given, and bad pixels. A gain says that the unit of the
        frames is known.
    optics : mapping
        pixel_scale_arcsec, subaperture_m and diameter_m of the layout.
    grid : (int, int), optional
        Rows and columns of an array that fills the frame; only which lenslets are illuminated is searched.
    factor : int
        Bin of the layout.
    exclude : sequence of int
        Sub-apertures to leave out.
    mask_hot_pixels : bool
        Whether isolated bright pixels become bad pixels.
    **options
        As for `find_layout`, or with a grid for `find_illuminated`.

    Raises
    ------
    InputError
        If no sub-apertures are found, or a value is out of range.
    """
    mean, first, saturation_adu, notes = _usual_frames(source, calibration)
    hot = find_hot_pixels(mean) if mask_hot_pixels else np.empty((0, 2), np.int64)
    mean[tuple(hot.T)] = np.nan
    has_dark = calibration.dark is not None
    shown, unused = (mean, []) if grid is not None else _clearer_frame(mean, calibration)

    def found_in_bins(factor: int) -> FoundLayout | KnownGrid:
        if factor == 1:
            return found_in(shown, grid, has_dark=has_dark, **options)
        image, choices = binned(shown, factor).astype(np.float64), _binned_options(options, factor)
        return found_in(image, grid, has_dark=has_dark, **choices).magnified(factor, source.shape)

    with errors_within(source.description):
        found = found_in_bins(factor)
        if factor == 1 and (factor := _needed_bin(found, options)) > 1:
            found = found_in_bins(factor)
            unused.append(f"bin {factor}: windows of {LARGEST_WINDOW} px would cut such wide spots")
    found = found[_kept(len(found.layout), exclude)]
    layout = replace(found.layout, **optics, doubts=found.doubts)
    result = _Completed(calibration, unused + notes)
    result.add_background(found, layout, mean)
    layout = replace(layout, doubts=(*layout.doubts, *result.doubts))
    if len(hot):
        bad = result.calibration.with_bad_pixels(hot).bad_pixels
        result.estimate(f"{len(hot)} hot pixels masked", bad_pixels=bad)
    if source.note:
        result.note(f"{source.description}: {source.note}")
    if result.calibration.saturation_adu is None and saturation_adu is not None:
        text = f"saturation {saturation_adu:g} ADU, at which values pile up"
        result.estimate(text, saturation_adu=saturation_adu)
    seen = first_settings(layout, result.calibration, first)
    is_known = given.get("gain_e_per_adu") is not None or calibration.gain_e_per_adu != 1.0
    if not is_known and 0 < seen.flux < _FEWEST_E:
        is_known = True
        result.add_gain(seen)
        seen = first_settings(layout, result.calibration, first)
    if (dark := given.get("dark")) is not None and not is_number(dark):
        result.add_darks(dark, "e-" if is_known else "ADU", keeps_noise=given.get("read_noise_e") is not None)
    if isinstance(found, FoundLayout) and not seen.flux > 0:
        raise InputError(
            f"{source.description}: expected spots, found none in the {len(layout)} windows of the layout; "
            "average more frames, or look whether the frames are read right"
        )
    if result.calibration.read_noise_e is None and seen.noise > 0:
        result.estimate("", read_noise_e=float(f"{seen.noise * calibration.em_gain:.3g}"))
    unit = "e-" if is_known else "ADU"
    return FirstLayout(layout, result.calibration, seen, found, mean, unit, result.notes)


def found_in(
    mean: Floats, grid: tuple[int, int] | None = None, *, has_dark: bool = False, **options: Any
) -> FoundLayout | KnownGrid:
    """Find the sub-apertures in a frame; refuse frames of a colour camera."""
    bad = np.isnan(mean)
    searched = {"bad_pixels": bad, "grid": grid, **options}
    if grid is not None:
        return find_grid(mean, grid, has_dark, searched)
    found = find_layout(np.where(bad, 0, mean), **searched)
    lenslets = found.lenslets
    contrast = mosaic_contrast(mean, lenslets.spots, lenslets.pitch_px, lenslets.spot_px)
    if contrast > 1:
        raise InputError(
            f"pixels of even and odd rows and columns differ by a factor of {contrast:.2g} in the spots, as "
            "in raw frames of a colour camera (Bayer mosaic); --bin 2 (bin = 2 in [layout]) sums them, "
            "--flat with a flat field in the same light corrects them"
        )
    return found


def _needed_bin(found: FoundLayout | KnownGrid, options: Mapping[str, Any]) -> int:
    """Return the smallest bin in whose pixels the largest window holds the weight of a spot."""
    if isinstance(found, KnownGrid) or options.get("pixels") is not None:
        return 1
    return math.ceil(found.lenslets.spot_px / FWHM_TO_STD / WIDEST_PX)


def _kept(count: int, excluded: Sequence[int]) -> NDArray[np.bool_]:
    """Return which of so many sub-apertures are not excluded."""
    if len(excluded) and max(excluded) >= count:
        raise InputError(f"expected sub-apertures from 0 to {count - 1}", name="exclude", value=max(excluded))
    kept = ~np.isin(np.arange(count), excluded)
    if not kept.any():
        raise InputError(f"no sub-aperture is left of {count}", name="exclude")
    return kept


def _binned_options(options: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return the options with distances and points in the pixels of binned frames."""
    changed = dict(options)
    for name, value in options.items():
        if value is None:
            continue
        if name == "pitch_px":
            changed[name] = value / factor
        elif name == "pixels":
            changed[name] = [side // factor for side in window_size(name, value, factor)]
        elif name == "roi":
            changed[name] = (np.array(value) // factor).tolist()
        elif name in ("centre", "pupil"):
            radii = [radius / factor for radius in value[2:]]
            changed[name] = [*scaled_points(value[:2], 1 / factor).tolist(), *radii]
    return changed


def _usual_frames(
    source: FrameSource, calibration: Calibration
) -> tuple[Floats, NDArray[np.generic], float | None, list[str]]:
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
    chosen = np.flatnonzero(usual)[:_FIRST_FRAMES]
    first = source.block(int(chosen[0]), int(chosen[-1]) + 1)[chosen - chosen[0]]
    if reason := misread(first[0]):
        raise InputError(f"{source.description}: {reason}")
    mean = seen.mean
    if not usual.all():
        mean_frame, flags = MeanFrame(source.shape), iter(usual)
        for block in blocks():
            mean_frame.add(block[[next(flags) for _ in block]])
        mean = mean_frame.mean
    for which, reason in (
        (unlike, "at least twice as bright or half as bright as most, or with another background"),
        (repeated & ~unlike, "repeated, the same as the one before"),
    ):
        if which.any():
            notes.append(f"{np.count_nonzero(which)} of {count} frames left out: {reason}")
    if np.isnan(mean).all():
        raise InputError(f"{source.description}: expected a frame with spots, every pixel is NaN or infinite")
    dark, electrons_per_adu = calibration.maps(source.shape)
    return (mean - dark) * electrons_per_adu, first, seen.saturation_adu, notes


def _clearer_frame(mean: Floats, calibration: Calibration) -> tuple[Floats, list[str]]:
    """Return the frame with or without the structure of its dark, whichever shows spots better, and a note.

    Spots are found above their own background, so that a dark helps only where it takes off a pattern. A
    noisy one, or one that was taken with light, adds one.
    """
    if not isinstance(calibration.dark, np.ndarray):
        return mean, []
    dark, electrons_per_adu = calibration.maps((mean.shape[0], mean.shape[1]))
    without = mean + (dark - np.nanmedian(dark)) * electrons_per_adu
    if _roughness(mean) <= _roughness(without):
        return mean, []
    text = "the sub-apertures were found without the dark, which adds noise or structure as large as spots"
    return without, [text]


def _roughness(image: Floats) -> float:
    """Return the standard deviation of structures as large as spots, between these."""
    filled = np.where(np.isfinite(image), image, np.nanmedian(image))
    band = scipy.ndimage.gaussian_filter(filled, 1.0) - scipy.ndimage.gaussian_filter(filled, 4.0)
    return mad_std(band)


def is_quad_cell(layout: Layout) -> bool:
    """Whether windows have two pixels on a side: every estimator is a difference of halves there."""
    return min(layout.window) == _QUAD_CELL


@dataclass
class _Completed:
    """Calibration that is completed by what frames show, and a line on each value."""

    calibration: Calibration
    notes: list[str]
    doubts: tuple[str, ...] = ()

    def note(self, text: str) -> None:
        self.notes.append(text)

    def estimate(self, text: str, **values: object) -> None:
        """Add estimated values, and a line on them."""
        estimated = (*self.calibration.estimated, *values)
        self.calibration = replace(self.calibration, **values, estimated=estimated)  # type: ignore[arg-type]
        if text:
            self.note(text)

    def add_background(self, found: FoundLayout | KnownGrid, layout: Layout, mean: Floats) -> None:
        """Take the background of the frame as dark level where none is known."""
        calibration, edges = self.calibration, layout.images(mean)[:, [0, -1]]
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
                height = float(np.median(found.lenslets.flux)) / (2 * np.pi * found.lenslets.spot_px**2)
                if background is not None and np.ptp(np.quantile(levels, _MOST_LEVELS)) > height:
                    self.doubts += ("the background under overlapping spots varies more than they are high",)
        if background is not None:
            dark = (background * adu_per_electron).astype(np.float32)
            low, high = (plain(float(end)) for end in np.quantile(dark, _MOST_LEVELS))
            text = f"{low} to {high} ADU: the background varies, as reflections and haze do"
            if calibration.dark is not None:
                self.note(f"{text}; only the dark that is given is subtracted, and slopes contain the rest")
            else:
                self.estimate(f"dark is a map, {text}; --dark gives the camera's own", dark=dark)
        elif calibration.dark is None and level > spread > 0:
            level = float(f"{level:.7g}")
            text = f"dark {level:g} ADU, the frame's background; --dark gives the camera's own"
            self.estimate(text, dark=level)

    def add_gain(self, seen: FirstSettings) -> None:
        """Assume a gain for spots of which 1 would leave hardly an electron."""
        noise_e = self.calibration.typical_read_noise_e or ASSUMED_NOISE_E
        likely = float(f"{noise_e / seen.noise:.3g}")
        text = f"gain: 1 would leave {plain(seen.flux)} electrons of a spot; {likely:g} is assumed"
        self.estimate(text, gain_e_per_adu=likely)

    def add_darks(self, location: str, unit: str, *, keeps_noise: bool) -> None:
        """Add noise and bad pixels of a file of dark frames; not of few frames, or of frames with NaN."""
        with open_frames([location]) as frames:
            count = min(frames.n_frames, _MOST_NUMBERS // (frames.shape[0] * frames.shape[1]))
            darks = frames.block(0, count) if count >= FEWEST_FRAMES and min(frames.shape) >= 4 else None
        if darks is None or not np.isfinite(darks).all():
            return
        pixels, calibration = measure_detector(darks=darks).pixels, self.calibration
        if pixels is None:
            return
        if not keeps_noise:
            electrons_per_adu = replace(calibration, bad_pixels=None).maps(pixels.noise_adu.shape)[1]
            noise = pixels.noise_adu * electrons_per_adu * calibration.em_gain
            calibration = replace(calibration, read_noise_e=noise)
            rms, median = calibration.typical_read_noise_e, float(np.nanmedian(calibration.read_noise_e))
            self.note(f"read noise of each pixel from the darks: median {median:.3g}, rms {rms:.3g} {unit}")
        bad = np.concatenate([pixels.blinking, pixels.hot])
        if len(bad):
            calibration = calibration.with_bad_pixels(bad)
            self.note(f"{len(pixels.blinking)} pixels that blink and {len(pixels.hot)} hot ones masked")
        self.calibration = calibration


def _background(found: FoundLayout, mean: Floats) -> tuple[Floats, Floats | None]:
    """Return the background at each spot, and of all pixels, if it varies enough to change slopes."""
    grid = found.lenslets
    spots = grid.spots @ np.array([1, 1j])
    beside = neighbour_vectors(grid.geometry, grid.pitch_px, grid.angle_deg)
    background = lenslet_background(mean, spots, beside, grid.pitch_px, grid.spot_px)
    levels, flux = values_at(background, spots), float(np.median(grid.flux))
    least = least_difference(mean, flux, grid.pitch_px, grid.spot_px)
    return levels, background if varies(levels, least) else None
