"""Weights and matrices of a configuration as FITS, for controllers that faintspot does not run in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import check_ending
from faintspot.io.arrays.fits_units import write_images
from faintspot.io.optional_packages import load_fits
from faintspot.io.references import read_reference
from faintspot.loop.control.configuration import Control, load_control
from faintspot.slopes.estimators.built_in.window import NONE, Window
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.spots.fixed_weights import FixedWeights

Images = dict[str, NDArray[Any]]
_UNITS = dict.fromkeys(("REFERENCE", "OFFSET", "LINEAR_X", "LINEAR_Y", "INTERACTION_MATRIX"), "pixel")


def export_fits(
    configuration_file: str | Path,
    output: str | Path,
    *,
    reference: ArrayLike | str | Path | None = None,
) -> tuple[str, ...]:
    """Write the weights of estimator "window" and the matrices of [control] to a FITS file.

    Images are float32, (n, ny, nx) for n sub-apertures in the layout's order, unless stated otherwise:

    - CORNERS (n, 2), int32: row and column of each window's first pixel, counted from 0;
    - WEIGHTS: pixel weights of a centre of gravity c, with maximum 1; GAIN and REFERENCE (n, 2), x and y: the
      slope is gain (c - reference), with c and reference in px from the window's centre;
    - LINEAR_X, LINEAR_Y, MEAN_SPOT: the same as sums, for known flux: the slope is the sum of LINEAR_X times
      (pixels / flux - MEAN_SPOT), minus OFFSET, px;
    - FLUX: the flux is the sum of FLUX times the pixels;
    - OFFSET (n, 2): contribution of the references to the slopes from sums;
    - INTERACTION_MATRIX (2 n, commands): measured slopes (all x, then all y, px) for a unit of each command;
    - CONTROL_MATRIX (commands, 2 n): commands that cause such slopes; an integrator subtracts its gain times
      these.

    WEIGHTS, GAIN and REFERENCE are absent for weights that are not those of a centre of gravity. Other
    estimators have no weights; without [control] there are no matrices.

    Parameters
    ----------
    configuration_file : path
        faintspot.toml, with estimator "window", [control] or both.
    output : path
        A name ending in .fits.
    reference : array or path, optional
        Reference slopes, px, as for `SlopePipeline`. Default: those of [control], if any.

    Returns
    -------
    tuple of str
        Names of the images written.

    Raises
    ------
    InputError
        When there is nothing to write, the ending is another one, or a file cannot be read or written.
    MissingExtraError
        When astropy is not installed.
    """
    path = Path(output)
    check_ending(path, ".fits")
    load_fits()
    described = configuration.Configuration(configuration_file)
    control = load_control(described)
    pipeline = _pipeline(described, reference, control)
    images: Images = {"CORNERS": pipeline.layout.corners.astype(np.int32)}
    if control is None or isinstance(pipeline.settings.estimator, Window):
        images |= _weights(pipeline)
    if control is not None:
        control.check_fits(len(pipeline.layout))
        gain = control.centroid_gain
        images["INTERACTION_MATRIX"] = control.interaction * gain
        images["CONTROL_MATRIX"] = control.reconstructor.matrix / gain
    kept = {
        name: values if values.dtype.kind == "i" else values.astype(np.float32)
        for name, values in images.items()
    }
    write_images(path, kept, _UNITS)
    return tuple(images)


def _pipeline(
    described: configuration.Configuration,
    reference: ArrayLike | str | Path | None,
    control: Control | None,
) -> SlopePipeline:
    """Return the pipeline of a configuration file, with the given reference slopes or those of [control]."""
    layout, path = described.layout, described.path
    if layout.bin > 1:
        raise InputError(f"{path}: layout.bin = {layout.bin}: expected 1, weights are of the camera's pixels")
    slopes: Any = read_reference(reference) if isinstance(reference, str | Path) else reference
    if slopes is None and control is not None:
        slopes = control.reference
    with errors_within(path):
        return SlopePipeline(layout, described.settings, described.calibration, slopes, **described.spot)


def _weights(pipeline: SlopePipeline) -> Images:
    """Return the weights of estimator "window", one set for each sub-aperture."""
    estimator, sensor = pipeline.settings.estimator, pipeline.plan.sensor
    if not isinstance(estimator, Window):
        raise InputError(
            f"estimator {estimator.name!r}: expected 'window', which has fixed weights, or a table [control]"
        )
    if estimator.normalisation == NONE:
        raise InputError('estimator.normalisation = "none": expected "mean" or "frame"')
    found: FixedWeights = pipeline.plan.prepared.weights  # type: ignore[attr-defined]
    kinds = found.kinds(len(pipeline.layout))
    weights = FixedWeights(*(maps[kinds] for maps in (found.x, found.y, found.mean_spot, found.flux)))
    # Weights from a file are centred on the sub-apertures, Gaussian windows on the references.
    given = isinstance(sensor.score, FixedWeights)
    offset = sensor.zero - sensor.layout.offsets if given else np.zeros_like(sensor.zero)
    images: Images = {}
    try:
        centre = weights.weighted_centre()
        images |= {"WEIGHTS": centre.weights, "GAIN": centre.gain}
        images["REFERENCE"] = centre.reference + offset / centre.gain
    except InputError:
        pass  # no centre of gravity: sums only
    images |= {"LINEAR_X": weights.x, "LINEAR_Y": weights.y, "MEAN_SPOT": weights.mean_spot}
    return images | {"FLUX": weights.flux, "OFFSET": offset}
