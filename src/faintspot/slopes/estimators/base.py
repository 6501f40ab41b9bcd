"""Base class of the estimators: a frozen dataclass of options that describes itself completely.

Other code (pipeline, study, planner, closed loop, real time, reports, command line) queries the object and
never tests its name.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.options import Options, is_auto
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.kernels.groups import COMMON_ROWS, flux_of_groups


class Need(enum.Enum):
    """Prior knowledge that an estimator may require; the value describes it as in error messages.

    Examples
    --------
    >>> from faintspot.slopes.estimators import estimator_named
    >>> sorted(need.name for need in estimator_named("ml").needs)
    ['PSF', 'READ_NOISE']
    """

    READ_NOISE = "calibration.read_noise_e: expected the read noise (electrons)"
    WIDTH = "settings.spot_fwhm_px: expected the spots' width (px), or a PSF,"
    PSF = "psf: expected a PSF"


_MAKERS = {
    Need.READ_NOISE: "; read_noise_e in [calibration] gives it (faintspot layout --read-noise-e)",
    Need.PSF: "; faintspot.learn_psf makes one",
}


class Style(NamedTuple):
    """Colour, line and marker of an estimator in figures.

    Examples
    --------
    >>> from faintspot.slopes.estimators import Style
    >>> Style("tab:red", line="--")
    Style(colour='tab:red', line='--', marker='o')
    """

    colour: str
    line: str = "-"
    marker: str = "o"


class Step(NamedTuple):
    """Processing step whose images are shown in figures."""

    title: str
    stage: str
    """Name of the images in `faintspot.Stages`."""


RAW, CALIBRATED = Step("raw", "raw"), Step("calibrated", "calibrated")
BACKGROUND = Step("background subtracted", "background_subtracted")


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimator(Options):
    """Method that finds the position of the spot in a sub-aperture image.

    A subclass is a frozen dataclass (`@dataclass(frozen=True, eq=False, kw_only=True)`) whose fields are
    its options, declared by `faintspot.slopes.estimators.option`. It overrides `locate` (NumPy) or `plan`
    (compiled kernel). Register it by name with `faintspot.slopes.estimators.register`, or, in an installed
    package, with the entry point group `faintspot.estimators`.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.estimators import Estimator
    >>> @dataclass(frozen=True, eq=False, kw_only=True)
    ... class BrightestPixel(Estimator):
    ...     name = "brightest_pixel"
    ...     label = "brightest pixel"
    ...     def locate(self, images, sensor, prior):
    ...         ny, nx = sensor.window
    ...         y, x = np.divmod(images.reshape(-1, ny * nx).argmax(1), nx)
    ...         return np.stack([x - (nx - 1) / 2, y - (ny - 1) / 2], axis=1)
    >>> image = np.zeros((1, 8, 8))
    >>> image[0, 2, 5] = 10.0
    >>> slopes = fs.measure_images(image, BrightestPixel())
    >>> float(slopes.x[0]), float(slopes.y[0])
    (1.5, -1.5)
    """

    name: ClassVar[str]
    """Name in configuration files and on the command line."""
    label: ClassVar[str]
    """Name in reports and figures."""
    method: ClassVar[str] = ""
    """Short description of the method."""
    needs: ClassVar[frozenset[Need]] = frozenset()
    cost: ClassVar[float] = 1.0
    """Run time relative to the pipeline with 20 iterations of TV denoising (16 x 16 px); measured once."""
    style: ClassVar[Style] = Style("#666666", "-.", "d")
    steps_shown: ClassVar[tuple[Step, ...]] = (RAW, CALIBRATED)
    """Steps shown in figures, in order."""
    takes_prior: ClassVar[bool] = False
    """Whether slopes predicted by a control loop improve the estimate."""
    strength_option: ClassVar[str | None] = None
    """Option that is the strength of the denoising, as in the method `tv:0.6`."""
    plan: ClassVar[type[EstimatorPlan] | None] = None
    """Class of the tables that are computed for a sensor before the first frame; None if `locate` is used."""

    # Description ---------------------------------------------------------------------------------------

    @property
    def required(self) -> frozenset[Need]:
        """Prior knowledge that is required with the current options."""
        return self.needs

    @property
    def uses_flux(self) -> bool:
        """Whether knowing the mean flux (see `faintspot.MeanFlux`) improves the estimate."""
        return False

    def without_denoising(self) -> Estimator | None:
        """Return the same estimator without denoising, or None if it does not denoise."""
        return None

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """Describe in one line the processing of n sub-apertures with the given number of pixels."""
        options = ", ".join(f"{name} {self._span(name, n_subapertures, pixels)}" for name in self.chosen())
        return f"{self.method or self.label}{f' ({options})' if options else ''}"

    def for_scene(self, scene: Scene) -> Self:
        """Return a copy with the options that follow from a scene alone, before any are tuned."""
        return self

    def for_bright_flux(self) -> Estimator:
        """Return an equivalent estimator for bright, noise-free images, as used for reference positions."""
        return self

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return the options to tune for a scene and their candidate values, the usual value first."""
        return {}

    # Preparation and measurement ----------------------------------------------------------------------

    def locate(self, images: NDArray[np.float32], sensor: Sensor, prior: Floats) -> object:
        """Return the positions of the spots of one frame; override this in an estimator without a kernel.

        Parameters
        ----------
        images : (n, ny, nx) float32
            Calibrated sub-aperture images, electrons; bad pixels are filled.
        sensor : Sensor
        prior : (n, 2) float64
            Predicted positions, px from the window centres.

        Returns
        -------
        array (n, 2) or Positions
            x and y, px from the window centres. Values that are not finite are flagged and raise no error.
        """
        raise NotImplementedError(f"{type(self).__name__}: expected an estimator with `locate` or `plan`")

    def check(self, sensor: Sensor) -> None:
        """Raise an error if required knowledge about the sensor is missing.

        Raises
        ------
        InputError
            If something is missing.
        """
        missing = {
            Need.PSF: sensor.psf is None,
            Need.READ_NOISE: sensor.calibration.read_noise_e is None,
            Need.WIDTH: bool(np.isnan(sensor.spot_fwhm_px).any()),
        }
        for need in (need for need in Need if need in self.required):
            if missing[need]:
                wanted = f"estimator {self.name!r}" if need in self.needs else 'settings "auto"'
                raise InputError(f"{need.value} for {wanted}, got none{_MAKERS.get(need, '')}")

    def _span(self, name: str, n_subapertures: int, pixels: int) -> str:
        """Return an option's value, or its range if it varies, as text."""
        if isinstance(getattr(self, name), str):
            return "automatic" if is_auto(getattr(self, name)) else str(getattr(self, name))
        values = self.values(name, n_subapertures, pixels)
        if values.dtype.kind not in "iuf":
            return ", ".join(dict.fromkeys(str(value) for value in values))
        low, high = values.min(), values.max()
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"


class Positions(NamedTuple):
    """Positions and, optionally, flux and errors returned by `locate`; each of shape (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.estimators import Positions
    >>> found = Positions(np.array([0.1, 0.0]), np.array([-0.2, 0.0]), valid=np.array([True, False]))
    >>> found.valid
    array([ True, False])
    """

    x: NDArray[Any]
    y: NDArray[Any]
    flux: NDArray[Any] | None = None
    """Flux [electrons]. Default: sum of the image."""
    standard_error_x: NDArray[Any] | None = None
    standard_error_y: NDArray[Any] | None = None
    valid: NDArray[np.bool_] | None = None
    covariance_xy: NDArray[Any] | None = None
    """Covariance of x and y [px^2]. Default: 0."""


class EstimatorPlan:
    """Settings and tables of an estimator for one sensor, in the form that its kernel reads.

    Parameters
    ----------
    estimator : Estimator
    sensor : Sensor
    """

    kernel: Any = None
    """Compiled function that measures groups of sub-apertures: see `kernels.groups`."""
    tables: Any = None
    """Tables that the kernel reads in addition to the settings: a NamedTuple."""
    own_scratch: Any = None
    """Function that allocates the kernel's scratch memory; unchanged as long as `tables` are."""
    setting_rows: int = COMMON_ROWS
    """Number of rows in the settings table."""
    needs_flux: bool = False
    """Whether the flux is measured in every frame."""
    flux_kernel: Any = staticmethod(flux_of_groups)
    """Compiled function that measures the flux."""
    flux_step: float = 1.02
    """Measured flux is quantised in steps of this factor, so that settings change slowly."""
    rows_of_options: Mapping[str, int] = MappingProxyType({})
    """Rows of the settings table that hold an option as it is, on which nothing else depends."""
    prior_weight_row: int | None = None
    """Row of 1 / prior_std_px^2 in the settings table, for a prior whose width may change between frames."""
    in_python: bool = False
    """Whether the kernel only calibrates the images, and `locate_frame` finds the positions."""
    locate_frame: Any = None
    """Function that writes the slopes of one frame where `in_python`: see `estimators.python.PythonPlan`."""
    fewer_lanes_are_faster: bool = False
    """Whether an incomplete group is measured faster with a narrower SIMD vector."""
    pixel_variance: Floats
    """Variance of each dark pixel [electrons^2], (n, ny, nx), or (n, 1, 1) where it is the same in all."""
    faults: int = 0
    """Number of frames in which `locate` failed."""
    fault: str = ""
    """Message of the last failure, in one line."""

    def __init__(self, estimator: Estimator, sensor: Sensor) -> None:
        self.estimator, self.sensor = estimator, sensor
        self.pixel_variance = sensor.pixel_variance

    @property
    def variance(self) -> Floats:
        """Mean variance of the dark pixels of each sub-aperture [electrons^2], (n,)."""
        return self.pixel_variance.mean(axis=(1, 2))  # type: ignore[no-any-return]

    def each(self, name: str) -> NDArray[Any]:
        """Return an option's value for each sub-aperture."""
        return self.estimator.values(name, self.sensor.n, self.sensor.pixels)

    def fill(self, table: NDArray[np.float32]) -> None:
        """Fill the rows of the settings table that do not depend on the flux."""

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """Fill the rows that depend on the flux [electrons] of each sub-aperture; NaN where it is unknown."""


__all__ = [
    "BACKGROUND",
    "CALIBRATED",
    "RAW",
    "Estimator",
    "EstimatorPlan",
    "Need",
    "Positions",
    "Step",
    "Style",
]
