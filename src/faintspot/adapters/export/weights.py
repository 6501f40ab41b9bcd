"""Weights of estimator "window" as FITS, for controllers that use a weighted centre of gravity."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.adapters.export.sensor import centre_of, fixed_weights, offsets_of, pipeline_of
from faintspot.base.errors import InputError
from faintspot.base.files import write_atomically
from faintspot.io.optional_packages import load_fits


def export_weights(
    configuration_file: str | Path,
    output: str | Path,
    *,
    reference: ArrayLike | str | Path | None = None,
) -> tuple[str, ...]:
    """Write the weights of estimator "window" to a FITS file.

    Images are float32, (n, ny, nx) for n sub-apertures in the layout's order, unless stated otherwise:

    - CORNERS (n, 2), int32: row and column of each window's first pixel, counted from 0;
    - WEIGHTS: pixel weights of a centre of gravity c, with maximum 1; GAIN and REFERENCE (n, 2), x and y: the
      slope is gain (c - reference), with c and reference in px from the window's centre;
    - LINEAR_X, LINEAR_Y, MEAN_SPOT: the same as sums, for known flux: the slope is the sum of LINEAR_X times
      (pixels / flux - MEAN_SPOT), minus OFFSET, px;
    - FLUX: the flux is the sum of FLUX times the pixels;
    - OFFSET (n, 2): contribution of the references to the slopes from sums.

    WEIGHTS, GAIN and REFERENCE are absent for weights that are not those of a centre of gravity.

    Parameters
    ----------
    configuration_file : path
        faintspot.toml, with estimator "window".
    output : path
        A name ending in .fits.
    reference : array or path, optional
        Reference slopes, px, as for `SlopePipeline`.

    Returns
    -------
    tuple of str
        Names of the images written.

    Raises
    ------
    InputError
        When the estimator or the ending is another one, or a file cannot be read or written.
    MissingExtraError
        When astropy is not installed.
    """
    path = Path(output)
    if path.suffix.lower() != ".fits":
        raise InputError(f"{path}: expected a name ending in .fits")
    fits = load_fits()
    pipeline = pipeline_of(configuration_file, reference)
    weights = fixed_weights(pipeline)
    images: dict[str, Any] = {"CORNERS": pipeline.layout.corners.astype(np.int32)}
    units = {"REFERENCE": "pixel", "OFFSET": "pixel", "LINEAR_X": "pixel", "LINEAR_Y": "pixel"}
    try:
        centre = centre_of(pipeline, weights)
        images |= {"WEIGHTS": centre.weights, "GAIN": centre.gain, "REFERENCE": centre.reference}
    except InputError:
        pass  # no centre of gravity: sums only
    images |= {"LINEAR_X": weights.x, "LINEAR_Y": weights.y, "MEAN_SPOT": weights.mean_spot}
    images |= {"FLUX": weights.flux, "OFFSET": offsets_of(pipeline)}
    primary = fits.PrimaryHDU()
    primary.header["CREATOR"] = "faintspot"
    written = [primary]
    for name, values in images.items():
        kept = values if values.dtype.kind == "i" else values.astype(np.float32)
        unit = fits.ImageHDU(kept, name=name)
        if name in units:
            unit.header["BUNIT"] = units[name]
        written.append(unit)
    stream = io.BytesIO()
    fits.HDUList(written).writeto(stream, checksum=True)
    write_atomically(path, stream.getvalue())
    return tuple(images)
