"""Slopes of recorded frames: from files to a file, block by block, resumable."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base import __version__
from faintspot.base.errors import InputError, errors_within
from faintspot.base.flags import KEEPABLE, SubapertureFlag, kept_flags, scaled_positions
from faintspot.base.options import FLAG, TEXT, TEXTS, Options, number, setting
from faintspot.io.file_format import UNITS, pixels_in
from faintspot.io.frames import FrameSource, open_frames
from faintspot.io.slopes import create_writer, read_reference
from faintspot.io.stored_array import split_location
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.dark_frames import with_fitting_dark
from faintspot.slopes.camera.frame_checks import are_repeated
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.pipeline.light import MeanFlux
from faintspot.slopes.pipeline.settings import Settings, spot_fwhm_px, without_denoising
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes, layout_coordinates
from faintspot.slopes.recorded.survey import Survey, configured, frames_apart, response, stretches, survey
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.io.slopes_writer import SlopeWriter
    from faintspot.slopes.pipeline.following import SpotFollower

_BLOCK_BYTES = 1 << 25  # of float32 frames: large enough for all threads, small beside any memory

_FOLLOWED_FRAMES = 32  # of a block, one after the other: for the progress bar

_LOOKS_FOR_FLUX, _FRAMES_FOR_FLUX = 20, 50  # stretches of frames over the whole recording
_WIDE = 0.35  # width of wide spots, over the side of the window
_FRAMES_FOR_RESPONSE = 200  # fewest, as of the statistics that need it

Progress = Callable[[int, int], None]
"""Called with the number of finished frames and of all frames."""


@dataclass
class Summary:
    """Summary of a run over recorded frames."""

    n_frames: int
    n_subapertures: int
    notes: list[str] = field(default_factory=list)
    """Lines on what no configuration states: of frames, calibration, reference, and a failing estimator."""
    doubtful: bool = False
    """Whether the layout has doubts that nobody has settled."""
    resumed_at: int = 0
    flag_counts: dict[SubapertureFlag, int] = field(default_factory=dict)
    """Number of slopes of this call with each flag."""
    bad_frames: int = 0
    """Frames of this call without a single valid slope."""
    repeated_frames: int = 0
    """Frames of this call that are the same as the one before."""

    @property
    def measured(self) -> int:
        """Slopes made by this call."""
        return self.n_subapertures * (self.n_frames - self.resumed_at)

    def add(self, slopes: Slopes) -> None:
        """Count the flags of a block."""
        self.bad_frames += int(np.count_nonzero(~slopes.valid.any(axis=-1)))
        for flag in SubapertureFlag:
            count = int(np.count_nonzero(slopes.flags & flag))
            self.flag_counts[flag] = self.flag_counts.get(flag, 0) + count


@dataclass(frozen=True, eq=False)
class Choices(Options):
    """Choices on which the slopes depend: with others, it is another run."""

    key: str | None = setting(None, "Array to read from files that hold several.", kind=TEXT)
    time_axis: int | None = number(None, 0, 2, "Axis of cubes that counts the frames.", whole=True)
    denoise: bool = setting(
        True, "False switches the denoising off for all sub-apertures: the other method.", kind=FLAG
    )
    changes: Mapping[str, Any] | None = None
    """New values of settings by name, instead of those in the configuration; "estimator" is one."""
    unit: str = setting(
        "px",
        "Unit of positions and errors in the output; arcsec needs layout --pixel-scale-arcsec.",
        choices=tuple(UNITS),
    )
    mean_flux: bool = setting(
        False,
        "Take the flux of spots as their mean over the recording, not that of each frame: for steady, faint "
        "stars.",
        kind=FLAG,
    )
    follow: bool = setting(
        False,
        "Follow spots out of their windows, up to 1.5 pitches of a smooth aberration; resumed, the frames "
        "before are measured again.",
        kind=FLAG,
    )
    keep: Sequence[str] = setting(
        (),
        "Doubtful slopes that stay valid: limited (at search_range_px, or cut by their window), unlike (all "
        "neighbours).",
        kind=TEXTS,
        choices=tuple(KEEPABLE),
    )
    reference: NDArray[Any] | str | Path | None = None
    """Reference positions, as for `SlopePipeline`, or the file that holds them, as "file" or "file:key", or
    slopes of which they are the mean; see `faintspot.io.slopes.read_reference`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.follow and self.mean_flux:
            raise InputError("follow (--follow) and mean_flux (--mean-flux): expected one of them, got both")

    @property
    def reference_file(self) -> str | Path | None:
        """File of the reference positions."""
        return self.reference if isinstance(self.reference, str | Path) else None


def measure_recorded(
    frames: Sequence[str | Path],
    configuration_file: str | Path,
    output: str | Path,
    *,
    threads: int | None = None,
    block_frames: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **choices: Any,
) -> Summary:
    """Measure the slopes of all frames in some files and write them to a file.

    Interrupted and called again with the same arguments, it resumes where it stopped; without zarr, only a
    complete output is kept.

    Parameters
    ----------
    frames : sequence of path
        FITS, TIFF, .npy, .npz or Zarr; see `faintspot.io.open_frames`.
    configuration_file : path
        The TOML file with layout, settings and calibration. Where it has no layout, sub-apertures and
        reference slopes are those of the first file of frames, if that is an AOT file.
    output : path
        .zarr, .fits, .npz or .csv.
    threads : int, optional
        Most threads to use; default all processors.
    block_frames : int, optional
        Frames to work on at a time; default so many that a block takes 32 MB.
    overwrite : bool
        Replace an existing output of another run.
    progress : callable, optional
        Called with finished and all frames after every block.
    **choices
        Fields of `Choices`.

    Raises
    ------
    InputError
        When a file cannot be read or written, or frames and configuration do not fit together.
    """
    chosen = Choices(**choices)
    described, origin, positions = configured(configuration_file, frames, chosen.key)
    if isinstance(chosen.reference, str | Path):
        positions = read_reference(chosen.reference)
    elif chosen.reference is not None:
        positions = chosen.reference
    layout = described.layout
    with open_frames(frames, key=chosen.key, time_axis=chosen.time_axis) as source:
        _check_files(source, frames, output, layout, configuration_file)
        seen = survey(source.shape, stretches(source))
        pipeline, notes = _pipeline(described, positions, seen, chosen, threads)
        if chosen.mean_flux:
            pipeline = _with_mean_flux(pipeline, source)
        attributes = _attributes(pipeline, source, frames, described, chosen)
        if positions is not None:
            attributes["reference"] = np.asarray(positions).tolist()
        with errors_within(configuration_file):
            measure = _measuring(pipeline, seen, follow=chosen.follow)
        summary = Summary(source.n_frames, len(layout), doubtful=bool(layout.doubts))
        summary.notes = [note for note in (origin, *notes) if note]
        factor = pixels_in(chosen.unit, attributes)
        with create_writer(
            output,
            n_frames=source.n_frames,
            n_subapertures=len(layout),
            attributes=attributes,
            measured_attributes=partial(_response, measure, seen, source),
            coordinates=layout_coordinates(layout),
            overwrite=overwrite,
        ) as writer:
            _write(writer, measure, source, summary, kept_flags(chosen.keep), factor, block_frames, progress)
    return summary


def _write(
    writer: SlopeWriter,
    measure: SlopePipeline | SpotFollower,
    source: FrameSource,
    summary: Summary,
    kept: SubapertureFlag,
    factor: float,
    block_frames: int | None,
    progress: Progress | None,
) -> None:
    """Measure the frames that are not finished, and count what they show.

    `factor` is a pixel in the unit of the output.
    """
    prepared, last, follows = measure.plan.prepared, None, not isinstance(measure, SlopePipeline)
    summary.resumed_at = done = writer.finished()
    faults, size = prepared.faults, block_frames or _block_frames(source, follows)
    again = source.blocks(0, done, size) if follows and done < source.n_frames else ()
    for start, block in itertools.chain(again, source.blocks(done, source.n_frames, size)):
        slopes = replace(measure(block), keep=kept)
        if start >= done:
            writer.append(start, scaled_positions(slopes.variables, factor))
            summary.add(slopes)
            summary.repeated_frames += int(np.count_nonzero(are_repeated(block, last)))
        last = block[-1]
        if progress is not None:
            progress(start + len(block), source.n_frames)
    if failed := prepared.faults - faults:
        summary.notes.append(f"{failed} frames without slopes: {prepared.fault}")
    if not isinstance(measure, SlopePipeline) and (uncertain := measure.uncertain_frames):
        summary.notes.append(
            f"{uncertain} frames without valid slopes: their spots fit lenslets a pitch farther nearly as "
            "well, as of a source that lights more; make a layout from them, compare with wavefront --minus"
        )


def _pipeline(
    described: Configuration,
    positions: NDArray[Any] | None,
    seen: Survey,
    choices: Choices,
    threads: int | None,
) -> tuple[SlopePipeline, list[str]]:
    """Return the pipeline of the configuration and of what the frames show, and notes on the latter."""
    layout, settings = described.layout, _settings(described.settings, choices)
    try:
        calibration, notes = _calibration(described.calibration, settings, layout, seen)
        spot: dict[str, Any] = described.spot
        pipeline = SlopePipeline(layout, settings, calibration, positions, **spot, threads=threads)
    except InputError as error:
        about_reference = positions is not None and error.name == "reference"
        raise error.within((about_reference and choices.reference_file) or described.path) from None
    return pipeline, notes


def _measuring(pipeline: SlopePipeline, seen: Survey, *, follow: bool) -> SlopePipeline | SpotFollower:
    """Return the pipeline, or windows that follow their spots."""
    if not follow:
        return pipeline.with_dark(seen.mean)
    from faintspot.slopes.pipeline.following import SpotFollower

    return SpotFollower(pipeline)


def _response(
    measure: SlopePipeline | SpotFollower, seen: Survey, source: FrameSource
) -> dict[str, list[float]]:
    """Return the response of each sub-aperture as an attribute, if there are enough frames."""
    if not isinstance(measure, SlopePipeline) or source.n_frames < _FRAMES_FOR_RESPONSE:
        return {}
    return {"response": response(measure, seen.mean, frames_apart(source)).tolist()}


def _settings(settings: Settings, choices: Choices) -> Settings:
    """Return the settings as changed by the arguments."""
    if choices.changes:
        settings = settings.replace(**choices.changes)
    if not choices.denoise:
        settings = without_denoising(settings, "denoise = False (--no-denoise)")
    return settings


def _calibration(
    calibration: Calibration, settings: Settings, layout: Layout, seen: Survey
) -> tuple[Calibration, list[str]]:
    """Return the calibration with what the frames show, and notes on saturation and dark."""
    calibration.maps(layout.frame_shape)  # refuses maps of another shape
    notes = []
    if calibration.saturation_adu is None and seen.saturation_adu is not None:
        calibration = replace(calibration, saturation_adu=seen.saturation_adu)
        notes.append(
            f"values pile up at {seen.saturation_adu:g} ADU, taken as saturation; saturation_adu in "
            "[calibration] states it"
        )
    width = np.nan_to_num(spot_fwhm_px(settings, len(layout), layout.pixels))
    is_wide = bool(width.max() > _WIDE * min(layout.window))  # wings reach the border of windows
    calibration, background = with_fitting_dark(calibration, layout, seen.mean, is_wide=is_wide)
    return calibration, [*notes, background]


def _with_mean_flux(pipeline: SlopePipeline, source: FrameSource) -> SlopePipeline:
    """Return the pipeline for the mean flux of frames from all over the recording."""
    estimator = pipeline.settings.estimator
    if not estimator.uses_flux:
        raise InputError(f"mean flux: the estimator {estimator.name!r} does not use the flux of spots")
    starts = np.unique(np.linspace(0, max(source.n_frames - _FRAMES_FOR_FLUX, 0), _LOOKS_FOR_FLUX, dtype=int))
    flux = [
        pipeline(block).flux
        for start in starts.tolist()
        for _, block in source.blocks(start, min(start + _FRAMES_FOR_FLUX, source.n_frames), _FRAMES_FOR_FLUX)
    ]
    return pipeline.with_flux(MeanFlux(np.concatenate(flux)))


def _check_files(
    source: FrameSource,
    frames: Sequence[str | Path],
    output: str | Path,
    layout: Layout,
    configuration_file: str | Path,
) -> None:
    """Refuse frames of another shape, and to replace the frames by their slopes."""
    if Path(output).resolve() in [split_location(path)[0].resolve() for path in frames]:
        raise InputError(f"{output}: expected a name for the slopes, got a file of the frames")
    if source.shape != layout.frame_shape:
        got, expected = (f"{height} x {width}" for height, width in (source.shape, layout.frame_shape))
        raise InputError(
            f"{source.description}: frames of {got} pixels, expected {expected} as in {configuration_file}"
        )


def _block_frames(source: FrameSource, follow: bool) -> int:
    """Return the number of frames to work on at a time."""
    height, width = source.shape
    return _FOLLOWED_FRAMES if follow else max(1, _BLOCK_BYTES // (4 * height * width))


def _version(path: Path) -> str:
    """Return values that change when a file of frames is written to."""
    status = path.stat()
    return "" if path.is_dir() else f"{status.st_size} {status.st_mtime_ns}"


def _attributes(
    pipeline: SlopePipeline,
    source: FrameSource,
    frames: Sequence[str | Path],
    described: Configuration,
    choices: Choices,
) -> dict[str, Any]:
    """Return the attributes of the output; the fingerprint decides whether a run may be continued."""
    key, unit, keep, file = choices.key, choices.unit, sorted(choices.keep), choices.reference_file
    text = configuration.to_text(pipeline.layout, pipeline.settings, pipeline.calibration)
    paths = [str(Path(path).resolve()) for path in frames]
    state = hashlib.sha256()
    for part in (
        __version__,
        text,
        str(key),
        *([] if unit == "px" else [unit]),
        *keep,
        *(["follow"] if choices.follow else []),
        *paths,
        *(_version(split_location(path)[0]) for path in frames),
        str((source.n_frames, source.shape, source.dtype)),
    ):
        state.update(part.encode() + b"\0")
    state.update(pipeline.fingerprint())
    scale = pipeline.layout.pixel_scale_arcsec
    return {
        "title": "Shack-Hartmann slopes",
        "unit": unit,
        **({} if scale is None else {"pixel_scale_arcsec": scale}),
        "configuration": text,
        "configuration_file": str(described.path.resolve()),
        **_files_of_the_spot(described),
        "sources": paths,
        "source_key": key or "",
        "keep": keep,
        **({"followed": True} if choices.follow else {}),
        "faintspot_version": __version__,
        "fingerprint": state.hexdigest(),
        **({} if choices.time_axis is None else {"source_time_axis": choices.time_axis}),
        **({} if file is None else {"reference_file": str(file)}),
    }


def _files_of_the_spot(described: Configuration) -> dict[str, str]:
    """Return the files of PSF and weights, for a report: their own, or the configuration."""
    path = described.path.resolve()
    return {
        f"{part}_file": str(path.parent / described[part].get("file", path.name))
        for part in ("psf", "weights")
        if part in described
    }
