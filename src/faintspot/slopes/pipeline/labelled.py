"""Conversion of slopes to labelled tables and arrays of other packages, with units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.variables import VARIABLES, scaled_positions
from faintspot.io.formats.csv_files import column_name
from faintspot.io.stored.slopes_format import COORDINATE_UNITS, UNITS, pixels_in, unit_of
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    import pandas
    import xarray

Variables = Mapping[str, NDArray[Any]]


def dataset_of(slopes: Variables, layout: Layout | None, unit: str) -> xarray.Dataset:
    """Return the result of `Slopes.to_xarray`."""
    try:
        import xarray
    except ImportError:
        raise MissingExtraError("xarray", "loop", "Slopes.to_xarray") from None
    variables, coordinates = _parts(slopes, layout, unit)
    attributes = {"unit": unit}
    return xarray.Dataset(
        {
            name: (
                ("frame", "subaperture"),
                values,
                {"units": unit_of(name, attributes), "long_name": VARIABLES[name].long_name},
            )
            for name, values in variables.items()
        },
        {
            name: ("subaperture", values, {"units": COORDINATE_UNITS.get(name, "1")})
            for name, values in coordinates.items()
        },
        attributes,
    )


def table_of_slopes(slopes: Variables, layout: Layout | None, unit: str) -> pandas.DataFrame:
    """Return the result of `Slopes.to_pandas`."""
    try:
        import pandas
    except ImportError:
        raise MissingExtraError("pandas", "loop", "Slopes.to_pandas") from None
    variables, coordinates = _parts(slopes, layout, unit)
    n_frames, n = variables["x"].shape
    index = pandas.MultiIndex.from_product([range(n_frames), range(n)], names=["frame", "subaperture"])
    columns = {column_name(name, unit): values.ravel() for name, values in variables.items()}
    columns |= {
        f"{name}_px" if name in COORDINATE_UNITS else name: np.tile(values, n_frames)
        for name, values in coordinates.items()
    }
    return pandas.DataFrame(columns, index)


def layout_coordinates(layout: Layout) -> dict[str, NDArray[np.generic]]:
    """Return the position of each sub-aperture in the form used in files of slopes."""
    return {
        "centre_x": layout.centres[:, 0],
        "centre_y": layout.centres[:, 1],
        "row": layout.cells[:, 0],
        "column": layout.cells[:, 1],
    }


def _parts(
    slopes: Variables, layout: Layout | None, unit: str
) -> tuple[dict[str, NDArray[np.generic]], dict[str, NDArray[np.generic]]]:
    """Return the variables (n_frames, n_subapertures) in the given unit, and the coordinates."""
    variables = {name: np.atleast_2d(slopes[name]) for name in VARIABLES}
    n = variables["x"].shape[1]
    if layout is not None and len(layout) != n:
        raise InputError(f"layout: expected {n} sub-apertures, as in the slopes, got {len(layout)}")
    scale = None if layout is None else layout.pixel_scale_arcsec
    factor = pixels_in(one_of("unit", unit, UNITS), {"pixel_scale_arcsec": scale})
    coordinates = {} if layout is None else layout_coordinates(layout)
    return scaled_positions(variables, factor), coordinates
