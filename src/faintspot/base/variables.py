"""Quantities that are known of every frame and sub-aperture, in results and in files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Variable:
    """Definition of a quantity that has a value for every frame and sub-aperture."""

    dtype: str
    units: str
    long_name: str
    csv_name: str
    if_absent: float | None = None
    """Value used if it is not given."""


VARIABLES: Mapping[str, Variable] = {
    "x": Variable("float32", "px", "spot position along columns, from the sub-aperture's centre", "x_px"),
    "y": Variable("float32", "px", "spot position along rows, from the sub-aperture's centre", "y_px"),
    "flux": Variable("float32", "e-", "flux left after background subtraction", "flux_e"),
    "valid": Variable("bool", "1", "position was measured and is not doubtful", "valid"),
    "flags": Variable(
        "uint8", "1", "how a position came about, as bits: see faintspot.SubapertureFlag", "flags"
    ),
    "iterations": Variable("int32", "1", "iterations of the denoiser", "iterations"),
    "bad_pixels": Variable("int32", "1", "pixels that were replaced", "bad_pixels"),
    "standard_error_x": Variable(
        "float32", "px", "standard error of x, infinite where not known", "standard_error_x_px", np.inf
    ),
    "standard_error_y": Variable(
        "float32", "px", "standard error of y, infinite where not known", "standard_error_y_px", np.inf
    ),
    "covariance_xy": Variable(
        "float32", "px^2", "covariance of the errors of x and y, 0 where not known", "covariance_xy_px2", 0.0
    ),
}


def scaled_positions(variables: Mapping[str, NDArray[Any]], factor: float) -> dict[str, NDArray[np.generic]]:
    """Return variables with positions and their errors converted to pixels of another size."""
    factors = {"px": np.float32(factor), "px^2": np.float32(factor**2)}
    return {
        name: values * factors[VARIABLES[name].units]
        if factor != 1 and VARIABLES[name].units in factors
        else values
        for name, values in variables.items()
    }
