"""Results of a pipeline: slopes, the images after every step, and their labelled tables and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import numbers_between, one_of, real_array
from faintspot.base.errors import InputError, MissingExtraError, drawn
from faintspot.base.flags import NO_FLAG, UNMEASURED, VARIABLES, SubapertureFlag, are_valid, scaled_positions
from faintspot.io.file_format import COORDINATE_UNITS, UNITS, pixels_in, unit_of
from faintspot.io.formats.csv_files import column_name
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes


RESULT_TYPES = tuple(map(np.dtype, ("f4", "f4", "f4", "u1", "i4", "i4", "f4", "f4", "f4")))


@dataclass(frozen=True, repr=False)
class Slopes:
    """Slopes of one frame, arrays of shape (n_subapertures,), or of several, (n_frames, n_subapertures).

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((2, 2), pixels=8)
    >>> frame = np.zeros(layout.frame_shape)
    >>> frame[2:4, 4:6] = 50.0
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=4))(frame)
    >>> slopes.valid
    array([ True, False, False, False])
    >>> float(slopes.x[0]), float(slopes.y[0]), float(slopes.flux[0])
    (1.0, -1.0, 200.0)
    >>> fs.SubapertureFlag(int(slopes.flags[1])).name
    'NO_FLUX'
    """

    x: NDArray[np.float32]
    """Position of the spot along columns, px from the reference position; 0 where not `measured`."""
    y: NDArray[np.float32]
    """Position of the spot along rows, likewise."""
    flux: NDArray[np.float32]
    """Flux after the background subtraction [electrons]."""
    flags: NDArray[np.uint8]
    """Bits of `SubapertureFlag`."""
    iterations: NDArray[np.int32]
    """Number of denoising iterations."""
    bad_pixels: NDArray[np.int32]
    """Number of pixels that were masked, NaN or infinite."""
    standard_error_x: NDArray[np.float32]
    """Standard error of x [px]; infinite where not `measured`, and where the read noise is unknown."""
    standard_error_y: NDArray[np.float32]
    covariance_xy: NDArray[np.float32]
    """Covariance of the errors of x and y [px^2]; 0 where a standard error is infinite."""
    keep: SubapertureFlag = field(default=NO_FLAG, kw_only=True)
    """Flags of `KEEPABLE` that do not make a slope invalid."""
    layout: Layout | None = field(default=None, kw_only=True, compare=False)
    """Layout of the sub-apertures; None of slopes that no pipeline has measured."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether the slope was measured, and is not limited, nor cut by its window or unlike all neighbours.

        The flags in `keep` do not count.
        """
        return are_valid(self.flags, self.keep)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether there is a position, however doubtful: what a control loop uses."""
        return (self.flags & UNMEASURED) == 0  # type: ignore[no-any-return]

    @property
    def vector(self) -> NDArray[np.float32]:
        """All x, then all y, along the last axis: the input vector of a reconstructor."""
        return np.concatenate([self.x, self.y], axis=-1)

    @classmethod
    def from_variables(
        cls,
        variables: Mapping[str, NDArray[Any]],
        n_frames: int | None = None,
        keep: SubapertureFlag = NO_FLAG,
        layout: Layout | None = None,
    ) -> Slopes:
        """Return the slopes from a file's variables, all frames or the first `n_frames`."""
        arrays = {item.name: variables[item.name][:n_frames] for item in fields(cls) if not item.kw_only}
        return cls(**arrays, keep=keep, layout=layout)

    @property
    def variables(self) -> dict[str, NDArray[np.generic]]:
        """Variables stored in files of slopes, by name."""
        return {name: getattr(self, name) for name in VARIABLES}

    def __repr__(self) -> str:
        valid = self.valid
        words = [
            f"frames {1 if self.x.ndim == 1 else len(self.x)}",
            f"sub-apertures {self.x.shape[-1]}",
            f"valid {100 * float(np.mean(valid)):.4g} %" if valid.size else "valid none",
        ]
        if valid.any():
            x, y, flux = (values[valid].astype(np.float64) for values in (self.x, self.y, self.flux))
            words += [
                f"rms of x, y {np.sqrt(np.mean(x**2)):.3g}, {np.sqrt(np.mean(y**2)):.3g} px",
                f"median flux {np.median(flux):.4g} e-",
            ]
        return f"Slopes({', '.join(words)})"

    def plot(self, axes: Axes | None = None, *, layout: Layout | None = None) -> Axes:
        """Draw the mean slope of each sub-aperture as an arrow, as `faintspot report` does.

        Arrows that are much longer than most are cut and black; crosses mark sub-apertures without a valid
        slope.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: new ones.
        layout : Layout, optional
            Default: that of the pipeline.

        Returns
        -------
        Axes

        Raises
        ------
        InputError
            If the layout is not known, or has another number of sub-apertures.
        MissingExtraError
            If matplotlib is not installed.
        """
        layout = self.layout if layout is None else layout
        axes = drawn("slopes.recorded.pictures:plot_slopes", self, layout, axes)
        return axes

    def to_xarray(self, layout: Layout | None = None, *, unit: str = "px") -> xarray.Dataset:
        """Return an xarray.Dataset with dimensions frame and subaperture, and units as attributes.

        Parameters
        ----------
        layout : Layout, optional
            Adds centre_x, centre_y (px), row and column as coordinates. Default: that of the pipeline.
        unit : {"px", "arcsec"}
            Unit of positions and standard errors; arcsec needs a layout with `pixel_scale_arcsec`.

        Raises
        ------
        InputError
            If the layout has another number of sub-apertures, or lacks the required pixel scale.
        MissingExtraError
            If xarray is not installed.
        """
        return dataset_of(self.variables, self.layout if layout is None else layout, unit)

    def to_pandas(self, layout: Layout | None = None, *, unit: str = "px") -> pandas.DataFrame:
        """Return a pandas.DataFrame with one row for each frame and sub-aperture, which form the index.

        Columns are named as in .csv files, such as x_px. Parameters and errors are those of `to_xarray`.
        """
        return table_of_slopes(self.variables, self.layout if layout is None else layout, unit)


def reference_positions(reference: ArrayLike | Slopes | None, layout: Layout) -> NDArray[np.float64]:
    """Return reference positions, given as for `SlopePipeline`, as (n, 2)."""
    n, side = len(layout), max(layout.frame_shape)
    if reference is None:
        return np.zeros((n, 2))
    values = reference.vector if isinstance(reference, Slopes) else reference
    hint = "; `faintspot wavefront --minus` subtracts slopes of another layout"
    array = numbers_between("reference", values, -side, side)
    return _vectors("reference", array, n, hint=hint)[0].T  # type: ignore[no-any-return]


def prior_slopes(prior: ArrayLike | Slopes, n_frames: int, layout: Layout) -> NDArray[np.float32]:
    """Return predicted slopes, given as for `SlopePipeline`, as the kernel reads them: (1 or n_frames, 2, n).

    Values larger than the frame, as of a diverged loop, are treated as not predicted.
    """
    array = real_array("prior", prior.vector if isinstance(prior, Slopes) else prior)
    vectors = _vectors("prior", array, len(layout), n_frames)
    possible = np.abs(vectors) <= max(layout.frame_shape)
    return np.ascontiguousarray(np.where(possible, vectors, 0.0), np.float32)


def _vectors(name: str, array: NDArray[Any], n: int, n_frames: int = 0, hint: str = "") -> NDArray[Any]:
    """Return x and y of n sub-apertures, of all frames or of each, as (1 or n_frames, 2, n)."""
    if array.shape in ((n, 2), (n_frames, n, 2)):
        array = np.moveaxis(array, -1, -2)
    elif array.shape not in ((2 * n,), (n_frames, 2 * n)):
        each = f", or as many for each of the {n_frames} frames" if n_frames else ""
        shapes = f"({n}, 2) or ({2 * n},), as the layout{each}"
        raise InputError(f"expected shape {shapes}, got {array.shape}{hint}", name=name)
    return array.reshape(-1, 2, n)


@dataclass(frozen=True)
class Stages:
    """Sub-aperture images after every step, (..., n_subapertures, ny, nx), and the slopes.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(layout, 1)
    >>> stages = fs.SlopePipeline(layout, fs.Settings(noise_std=0.5, keep_brightest=12)).explain(frames[0])
    >>> stages.denoised.shape
    (49, 16, 16)
    >>> bool(stages.denoised.std() < stages.calibrated.std())
    True
    """

    raw: NDArray[Any]
    """Raw pixels [ADU]."""
    calibrated: NDArray[np.float32]
    """Calibrated images [electrons], bad pixels filled in."""
    denoised: NDArray[np.float32]
    background_subtracted: NDArray[np.float32]
    slopes: Slopes


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
