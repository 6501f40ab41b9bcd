"""Parts of a configuration that are exported: its pipeline with reference slopes, and its control."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.errors import InputError
from faintspot.io.references import read_reference
from faintspot.loop.control.configuration import Control, load_control
from faintspot.slopes.estimators.built_in.window import NONE, Window
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.spots.fixed_weights import FixedWeights, WeightedCentre

Floats = NDArray[np.float64]


def pipeline_of(
    path: str | Path, reference: ArrayLike | str | Path | None, control: Control | None = None
) -> SlopePipeline:
    """Return the pipeline of a configuration file, with the given reference slopes or those of [control].

    Raises
    ------
    InputError
        When a file cannot be read, or its parts do not fit together.
    """
    layout, settings, calibration, psf, score = configuration.load_all(path)
    slopes: Any = read_reference(reference) if isinstance(reference, str | Path) else reference
    if slopes is None and control is not None:
        slopes = control.reference
    try:
        return SlopePipeline(layout, settings, calibration, slopes, psf=psf, score=score)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def control_of(path: str | Path) -> Control | None:
    """Return the control of a configuration file if it is an integrator; None without control.

    Raises
    ------
    InputError
        When it is another controller, and as for `faintspot.loop.control.configuration.load_control`.
    """
    control = load_control(path)
    if control is not None and control.model is not None:
        raise InputError(
            f"{path}: control.controller = {control.options.controller!r}: expected 'integrator', which "
            "is a control matrix; set that, or leave the control out"
        )
    return control


def fixed_weights(pipeline: SlopePipeline) -> FixedWeights:
    """Return the weights of estimator "window", one set for each sub-aperture.

    Raises
    ------
    InputError
        When the estimator is another one, or its sums are not divided by the flux.
    """
    estimator = pipeline.settings.estimator
    if not isinstance(estimator, Window):
        raise InputError(
            f"estimator {estimator.name!r}: expected 'window', which has fixed weights; those of others "
            "depend on the frame"
        )
    if estimator.normalisation == NONE:
        raise InputError('estimator.normalisation = "none": expected "mean" or "frame"')
    found: FixedWeights = pipeline.plan.prepared.weights  # type: ignore[attr-defined]
    kinds = found.kinds(len(pipeline.layout))
    return FixedWeights(*(maps[kinds] for maps in (found.x, found.y, found.mean_spot, found.flux)))


def offsets_of(pipeline: SlopePipeline) -> Floats:
    """Return the offsets that references subtract from the weights' slopes, (n, 2) px.

    Weights from a file are centred on the sub-apertures, Gaussian windows on the references.
    """
    sensor = pipeline.plan.sensor
    given = isinstance(sensor.score, FixedWeights)
    return sensor.zero - sensor.layout.offsets if given else np.zeros_like(sensor.zero)


def centre_of(pipeline: SlopePipeline, weights: FixedWeights) -> WeightedCentre:
    """Return the weighted centre of gravity of each sub-aperture, with the pipeline's reference.

    Raises
    ------
    InputError
        When the weights are not those of a centre of gravity.
    """
    centre = weights.weighted_centre()
    return centre._replace(reference=centre.reference + offsets_of(pipeline) / centre.gain)
