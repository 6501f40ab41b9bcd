"""Parameters of DARC, the Durham adaptive optics real-time controller, for a faintspot configuration.

Names, shapes, units and order follow DARC's manual (section on configuration); no code of DARC, which has
its own licence, is used.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.adapters.export.sensor import centre_of, control_of, fixed_weights, pipeline_of
from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, write_atomically
from faintspot.io.optional_packages import load_fits
from faintspot.loop.control.configuration import Control
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.centroid import CentreOfGravity
from faintspot.slopes.estimators.built_in.thresholded import Thresholded
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.kernels.gravity import gravity
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.spots.fixed_weights import WeightedCentre

FORMATS = ("fits", "npy")
LIST = "parameters.txt"
_NO_THRESHOLD, _SUBTRACTED = 0, 2

Floats = NDArray[np.float64]


class Parameter(NamedTuple):
    """One DARC parameter: a value, or an array that gets its own file."""

    name: str
    value: Any
    meaning: str

    @property
    def is_array(self) -> bool:
        """Whether it is written to a file of its own."""
        return isinstance(self.value, np.ndarray)


def export_darc(
    configuration_file: str | Path,
    folder: str | Path,
    *,
    reference: ArrayLike | str | Path | None = None,
    control: bool = True,
    form: str = "fits",
) -> list[Parameter]:
    """Write DARC's parameters for the sensor and estimator of a configuration.

    Parameters
    ----------
    configuration_file : path
        faintspot.toml, with estimator "brightest", "thresholded", "centroid" or "window".
    folder : path
        Folder, which must be empty or not exist: arrays as NAME.fits or NAME.npy, and parameters.txt with a
        line for each parameter.
    reference : array or path, optional
        Reference slopes, px, as for `SlopePipeline`. Default: those of [control], if any.
    control : bool
        Whether to write the control matrix of [control], if there is one.
    form : {"fits", "npy"}

    Returns
    -------
    list of Parameter
        The parameters written.

    Raises
    ------
    InputError
        When these parameters cannot express the estimator or controller, the folder is not empty, or a file
        cannot be read or written.
    MissingExtraError
        For FITS files, when astropy is not installed.
    """
    one_of("format", form, FORMATS)
    if form == "fits":
        load_fits()
    found = control_of(configuration_file) if control else None
    pipeline = pipeline_of(configuration_file, reference, found)
    if found is not None:
        found.check_fits(len(pipeline.layout))
    parameters = [*_of_sensor(pipeline), *_of_estimator(pipeline), *_of_control(pipeline, found)]
    _write(Path(folder), parameters, form)
    return parameters


def interleaved(slopes: ArrayLike) -> Floats:
    """Return slopes (..., 2 n), all x, then all y, in DARC's order: x, y of the first sub-aperture, ..."""
    array = np.asarray(slopes, np.float64)
    pairs = array.reshape(*array.shape[:-1], 2, array.shape[-1] // 2)
    return np.ascontiguousarray(pairs.swapaxes(-1, -2)).reshape(array.shape)


def _of_sensor(pipeline: SlopePipeline) -> Iterator[Parameter]:
    """Yield the geometry of the sub-apertures and the calibration of pixels to electrons."""
    layout = pipeline.layout
    (height, width), n = layout.frame_shape, len(layout)
    first, last = layout.corners, layout.corners + np.array(layout.window)
    places = np.column_stack([first[:, 0], last[:, 0], np.ones(n), first[:, 1], last[:, 1], np.ones(n)])
    dark, scale = pipeline.calibration.maps(layout.frame_shape)
    bad = ~np.isfinite(dark) | ~np.isfinite(scale)
    yield Parameter("ncam", 1, "cameras")
    yield Parameter("npxlx", _int([width]), "columns of a frame")
    yield Parameter("npxly", _int([height]), "rows of a frame")
    yield Parameter("nsub", _int([n]), "sub-apertures; only illuminated ones are written")
    yield Parameter("subapFlag", _int(np.ones(n)), "which sub-apertures are used")
    yield Parameter("subapLocType", 0, "sub-apertures are rectangles")
    yield Parameter("subapLocation", _int(places), "first row, row after the last, step; columns alike")
    yield Parameter("pxlCnt", _int(last[:, 0] * width), "pixels to wait for: up to the end of the last row")
    yield Parameter("windowMode", "basic", "windows do not move")
    yield Parameter("darkNoise", _map(np.where(bad, 0.0, dark)), "dark, ADU, row by row")
    yield Parameter("flatField", _map(np.where(bad, 0.0, scale)), "electrons per ADU; 0 in bad pixels")


def _of_estimator(pipeline: SlopePipeline) -> Iterator[Parameter]:
    """Yield the processing of a sub-aperture's pixels, and the reference positions."""
    n = len(pipeline.layout)
    estimator = pipeline.settings.estimator
    brightest, threshold, weights = np.zeros(n, np.int64), np.zeros(n), None
    if isinstance(estimator, BrightestPixels):
        brightest = _brightest(pipeline)
    elif isinstance(estimator, Thresholded):
        threshold = estimator.values("threshold_e", n, pipeline.layout.pixels)
    elif isinstance(estimator, Window):
        weights = _frame_of(pipeline, _centre(pipeline).weights)
    elif not isinstance(estimator, CentreOfGravity):
        raise InputError(
            f"estimator {estimator.name!r}: expected 'brightest', 'thresholded', 'centroid' or 'window', "
            "which DARC's parameters describe"
        )
    algorithm = _SUBTRACTED if isinstance(estimator, Thresholded) else _NO_THRESHOLD
    reference = interleaved(_centre(pipeline).reference.T.reshape(-1))
    yield Parameter("centroidMode", "CoG", "centre of gravity")
    yield Parameter("useBrightest", _int(brightest), "pixels kept; negative: the next one is subtracted")
    yield Parameter("thresholdAlgo", algorithm, "0: none, 2: subtracted, negative values become 0")
    yield Parameter("thresholdValue", threshold.astype(np.float32), "electrons")
    if weights is not None:
        yield Parameter("pxlWeight", weights, "weight of every pixel, row by row; 0 outside windows")
        yield Parameter("slope_gain", _slope_gain(pipeline), "px per px of DARC's slopes; included in rmx")
    yield Parameter("refCentroids", reference.astype(np.float32), "px from the centres of windows; x, y, ...")


def _brightest(pipeline: SlopePipeline) -> NDArray[np.int64]:
    """Return the number of brightest pixels per sub-aperture; the sign selects the subtraction."""
    estimator, n, pixels = pipeline.settings.estimator, len(pipeline.layout), pipeline.layout.pixels
    if pipeline.plan.needs_flux:
        raise InputError(
            'estimator.keep_brightest = "auto": expected settings.flux_e, the flux of the spots, which '
            "determines their number"
        )
    rank = pipeline.plan.settings[0][gravity.RANK].astype(np.int64)
    rules = estimator.values("rule", n, pixels)
    # If the pixel of that rank is subtracted, it is not kept.
    kept: NDArray[np.int64] = np.where(rules == "threshold", rank, 1 - rank)
    if not kept.all():
        raise InputError("estimator.keep_brightest = 1: expected at least 2 with rule 'subtract_kth'")
    return kept


def _centre(pipeline: SlopePipeline) -> WeightedCentre:
    """Return weights, gain and reference of each sub-aperture; weights are 1 unless it is "window"."""
    if isinstance(pipeline.settings.estimator, Window):
        return centre_of(pipeline, fixed_weights(pipeline))
    n = len(pipeline.layout)
    same = np.ones((n, *pipeline.layout.window))
    return WeightedCentre(same, np.ones((n, 2)), pipeline.plan.sensor.zero)


def _slope_gain(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Return the factor from DARC's slopes to px, (2 n,) in its order: weighting reduces a spot's motion."""
    return interleaved(_centre(pipeline).gain.T.reshape(-1)).astype(np.float32)


def _of_control(pipeline: SlopePipeline, control: Control | None) -> Iterator[Parameter]:
    """Yield the integrator, for slopes in DARC's order and scale."""
    if control is None:
        return
    options, commands = control.options, control.commands
    gain = _slope_gain(pipeline) / options.centroid_gain
    matrix = -interleaved(control.reconstructor.matrix) * gain
    moved = interleaved(control.interaction.T) / gain
    each = np.ones(commands, np.float32)
    yield Parameter("nacts", commands, "commands")
    yield Parameter("rmx", matrix.astype(np.float32), "commands added per slope, for gain 1")
    yield Parameter("gain", options.gain * each, "loop gain")
    yield Parameter("reconstructMode", "truth", "added to decayFactor times the last commands")
    yield Parameter("decayFactor", (1.0 - options.leak) * each, "1 minus the leak")
    yield Parameter("interaction", moved.astype(np.float32), "slopes per unit of each command; for scripts")


def _frame_of(pipeline: SlopePipeline, windows: Floats) -> NDArray[np.float32]:
    """Return a map of the whole frame, row by row, from maps of each window."""
    layout = pipeline.layout
    frame = np.zeros(layout.frame_shape)
    frame[layout.window_pixels] = windows
    return _map(frame)


def _map(frame: ArrayLike) -> NDArray[np.float32]:
    """Return a map of a frame as one row of numbers after another."""
    return np.asarray(frame, np.float32).reshape(-1)


def _int(values: ArrayLike) -> NDArray[np.int32]:
    return np.asarray(values).astype(np.int32)


def _write(folder: Path, parameters: list[Parameter], form: str) -> None:
    """Write the arrays, then the list of all parameters."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; choose another name")
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for parameter in parameters:
        value = parameter.value
        if parameter.is_array:
            write_atomically(folder / f"{parameter.name}.{form}", _content(parameter, form))
            shape = " x ".join(map(str, value.shape))
            value = f"{parameter.name}.{form} ({value.dtype}, {shape})"
        lines.append(f"{parameter.name}\t{value}\t{parameter.meaning}\n")
    write_atomically(folder / LIST, "".join(lines))


def _content(parameter: Parameter, form: str) -> bytes:
    """Return an array as the content of a file."""
    stream = io.BytesIO()
    if form == "npy":
        np.save(stream, parameter.value)
    else:
        unit = load_fits().PrimaryHDU(parameter.value)
        unit.header["CREATOR"], unit.header["PARAM"] = "faintspot", (parameter.name, "of DARC")
        unit.writeto(stream)
    return stream.getvalue()
