"""Parameters of DARC, the Durham adaptive optics real-time controller, for what faintspot is set to do.

Names, shapes, units and order are those of DARC's manual (its section on configuration); nothing else of
DARC, which has a licence of its own, is used here.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, write_atomically
from faintspot.control.configuration import Control
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.centroid import CentreOfGravity
from faintspot.estimators.thresholded import Thresholded
from faintspot.estimators.window import Window
from faintspot.export.sensor import centre_of, control_of, fixed_weights, pipeline_of
from faintspot.io.optional_packages import load_fits
from faintspot.kernels import gravity
from faintspot.pipeline.slope_pipeline import SlopePipeline
from faintspot.spots.fixed_weights import WeightedCentre

FORMATS = ("fits", "npy")
LIST = "parameters.txt"
_NO_THRESHOLD, _SUBTRACTED = 0, 2

Floats = NDArray[np.float64]


class Parameter(NamedTuple):
    """One parameter by its name in DARC: a value, or an array for a file of its own."""

    name: str
    value: Any
    meaning: str

    @property
    def is_array(self) -> bool:
        """Whether it is kept in a file."""
        return isinstance(self.value, np.ndarray)


def export_darc(
    configuration_file: str | Path,
    folder: str | Path,
    *,
    reference: ArrayLike | str | Path | None = None,
    control: bool = True,
    form: str = "fits",
) -> list[Parameter]:
    """Write what DARC's users set by hand, for the sensor and estimator of a configuration.

    Parameters
    ----------
    configuration_file : path
        faintspot.toml, with estimator "brightest", "thresholded", "centroid" or "window".
    folder : path
        A folder that does not exist yet, or is empty: arrays as NAME.fits or NAME.npy, and parameters.txt, a
        line for each parameter.
    reference : array or path, optional
        Reference slopes, px, as for `SlopePipeline`. Default: those of [control], if there are any.
    control : bool
        Whether to write the control matrix of [control], where there is one.
    form : {"fits", "npy"}

    Returns
    -------
    list of Parameter
        What was written.

    Raises
    ------
    InputError
        For an estimator or a controller that these parameters cannot express, a folder that is not empty,
        and for what cannot be read or written.
    MissingExtraError
        For FITS files without astropy.
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
    """Return (..., 2 n) slopes, all x, then all y, in DARC's order: x, y of the first sub-aperture, ..."""
    array = np.asarray(slopes, np.float64)
    pairs = array.reshape(*array.shape[:-1], 2, array.shape[-1] // 2)
    return np.ascontiguousarray(pairs.swapaxes(-1, -2)).reshape(array.shape)


def _of_sensor(pipeline: SlopePipeline) -> Iterator[Parameter]:
    """Where sub-apertures are, and how pixels become electrons."""
    layout = pipeline.layout
    (height, width), n = layout.frame_shape, len(layout)
    first, last = layout.corners, layout.corners + np.array(layout.window)
    places = np.column_stack([first[:, 0], last[:, 0], np.ones(n), first[:, 1], last[:, 1], np.ones(n)])
    dark, scale = pipeline.calibration.maps(layout.frame_shape)
    bad = ~np.isfinite(dark) | ~np.isfinite(scale)
    yield Parameter("ncam", 1, "cameras")
    yield Parameter("npxlx", _int([width]), "columns of a frame")
    yield Parameter("npxly", _int([height]), "rows of a frame")
    yield Parameter("nsub", _int([n]), "sub-apertures; only lit ones are written")
    yield Parameter("subapFlag", _int(np.ones(n)), "which sub-apertures are used")
    yield Parameter("subapLocType", 0, "sub-apertures are rectangles")
    yield Parameter("subapLocation", _int(places), "first row, row after the last, step; columns alike")
    yield Parameter("pxlCnt", _int(last[:, 0] * width), "pixels to wait for: up to the end of the last row")
    yield Parameter("windowMode", "basic", "windows stay where they are")
    yield Parameter("darkNoise", _map(np.where(bad, 0.0, dark)), "dark, ADU, row by row")
    yield Parameter("flatField", _map(np.where(bad, 0.0, scale)), "electrons per ADU; 0 in bad pixels")


def _of_estimator(pipeline: SlopePipeline) -> Iterator[Parameter]:
    """What is done with a sub-aperture's pixels, and where slopes are counted from."""
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
    yield Parameter("useBrightest", _int(brightest), "pixels that are kept; negative: the next one taken off")
    yield Parameter("thresholdAlgo", algorithm, "0: none, 2: taken off, what is negative becomes 0")
    yield Parameter("thresholdValue", threshold.astype(np.float32), "electrons")
    if weights is not None:
        yield Parameter("pxlWeight", weights, "weight of every pixel, row by row; 0 outside windows")
        yield Parameter("slope_gain", _slope_gain(pipeline), "px for 1 px of DARC's slopes; rmx has it")
    yield Parameter("refCentroids", reference.astype(np.float32), "px from the middles of windows; x, y, ...")


def _brightest(pipeline: SlopePipeline) -> NDArray[np.int64]:
    """Numbers of brightest pixels of every sub-aperture, with the sign that says what is taken off."""
    estimator, n, pixels = pipeline.settings.estimator, len(pipeline.layout), pipeline.layout.pixels
    if pipeline.plan.needs_flux:
        raise InputError(
            'estimator.keep_brightest = "auto": expected the flux of the spots, settings.flux_e, of which '
            "their number follows"
        )
    rank = pipeline.plan.settings[0][gravity.RANK].astype(np.int64)
    rules = estimator.values("rule", n, pixels)
    # Where the pixel of that rank is taken off, it is not kept.
    kept: NDArray[np.int64] = np.where(rules == "threshold", rank, 1 - rank)
    if not kept.all():
        raise InputError("estimator.keep_brightest = 1: expected at least 2 with rule 'subtract_kth'")
    return kept


def _centre(pipeline: SlopePipeline) -> WeightedCentre:
    """Weights, gain and reference of every sub-aperture; all weights 1 but for estimator "window"."""
    if isinstance(pipeline.settings.estimator, Window):
        return centre_of(pipeline, fixed_weights(pipeline))
    n = len(pipeline.layout)
    same = np.ones((n, *pipeline.layout.window))
    return WeightedCentre(same, np.ones((n, 2)), pipeline.plan.sensor.zero)


def _slope_gain(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Our slopes for DARC's, (2 n,) in its order: a weighted centre of gravity moves less than the spot."""
    return interleaved(_centre(pipeline).gain.T.reshape(-1)).astype(np.float32)


def _of_control(pipeline: SlopePipeline, control: Control | None) -> Iterator[Parameter]:
    """The integrator, for slopes in DARC's order and of DARC's size."""
    if control is None:
        return
    options, commands = control.options, control.commands
    gain = _slope_gain(pipeline) / options.centroid_gain
    matrix = -interleaved(control.reconstructor.matrix) * gain
    moved = interleaved(control.interaction.T) / gain
    each = np.ones(commands, np.float32)
    yield Parameter("nacts", commands, "commands")
    yield Parameter("rmx", matrix.astype(np.float32), "what slopes add to commands, for gain 1")
    yield Parameter("gain", options.gain * each, "loop gain")
    yield Parameter("reconstructMode", "truth", "added to the last commands, times decayFactor")
    yield Parameter("decayFactor", (1.0 - options.leak) * each, "1 less the leak")
    yield Parameter("interaction", moved.astype(np.float32), "slopes of a unit of each command; for scripts")


def _frame_of(pipeline: SlopePipeline, windows: Floats) -> NDArray[np.float32]:
    """A map of the whole frame, row by row, of maps of every window."""
    layout = pipeline.layout
    frame = np.zeros(layout.frame_shape)
    rows = layout.corners[:, 0, None, None] + np.arange(layout.window[0])[:, None]
    columns = layout.corners[:, 1, None, None] + np.arange(layout.window[1])
    frame[rows, columns] = windows
    return _map(frame)


def _map(frame: ArrayLike) -> NDArray[np.float32]:
    """A map of a frame as one row of numbers after the other."""
    return np.asarray(frame, np.float32).reshape(-1)


def _int(values: ArrayLike) -> NDArray[np.int32]:
    return np.asarray(values).astype(np.int32)


def _write(folder: Path, parameters: list[Parameter], form: str) -> None:
    """Write the arrays, then the list of all parameters."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already: choose another name")
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
    """One array as a file."""
    stream = io.BytesIO()
    if form == "npy":
        np.save(stream, parameter.value)
    else:
        unit = load_fits().PrimaryHDU(parameter.value)
        unit.header["CREATOR"], unit.header["PARAM"] = "faintspot", (parameter.name, "of DARC")
        unit.writeto(stream)
    return stream.getvalue()
