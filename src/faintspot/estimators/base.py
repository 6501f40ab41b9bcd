"""What an estimator is: a frozen dataclass of its own options that says everything about itself.

Everybody else (pipeline, study, planner, closed loop, real time, reports, command line) asks the object and
never its name.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.config.options import Options, is_auto
from faintspot.estimators.scene import Scene
from faintspot.estimators.sensor import Sensor
from faintspot.kernels.groups import COMMON_ROWS, flux_of_groups
from faintspot.spots.score import TrainedScore

Floats = NDArray[np.float64]


class Need(enum.Enum):
    """What an estimator may have to know; the value says it in words, and what provides it.

    Examples
    --------
    >>> from faintspot.estimators import estimator_named
    >>> sorted(need.name for need in estimator_named("ml").needs)
    ['PSF', 'READ_NOISE']
    """

    READ_NOISE = "calibration.read_noise_e: expected the read noise (electrons)"
    WIDTH = "settings.spot_fwhm_px: expected the spots' width (px), or a PSF,"
    PSF = "psf: expected a PSF"
    SCORE = "score: expected a TrainedScore"


_MAKERS = {
    Need.READ_NOISE: "; read_noise_e in [calibration] gives it (faintspot layout --read-noise-e)",
    Need.PSF: "; faintspot.learn_psf makes one",
    Need.SCORE: "; faintspot.train_estimator makes one",
}


class Style(NamedTuple):
    """How figures draw an estimator.

    Examples
    --------
    >>> from faintspot.estimators import Style
    >>> Style("tab:red", line="--")
    Style(colour='tab:red', line='--', marker='o')
    """

    colour: str
    line: str = "-"
    marker: str = "o"


class Step(NamedTuple):
    """A step whose images are worth a picture."""

    title: str
    stage: str
    """Name of the images in `faintspot.Stages`."""


RAW, CALIBRATED = Step("raw", "raw"), Step("calibrated", "calibrated")
BACKGROUND = Step("background subtracted", "background_subtracted")


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimator(Options):
    """A way to find the position of a spot in a sub-aperture's image.

    A subclass is a frozen dataclass (`@dataclass(frozen=True, eq=False, kw_only=True)`) whose fields are its
    options, declared by `faintspot.config.options.option`. It either overrides `locate`, in NumPy, or
    `prepared`, with a compiled kernel. `faintspot.estimators.register` makes it known by its name, as does
    the entry point group `faintspot.estimators` of an installed package.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.estimators import Estimator
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
    """What configuration files and command lines call it."""
    label: ClassVar[str]
    """What reports and figures call it."""
    method: ClassVar[str] = ""
    """How it works, in a few words."""
    needs: ClassVar[frozenset[Need]] = frozenset()
    cost: ClassVar[float] = 1.0
    """Time, in units of the pipeline with 20 iterations of TV denoising (16 x 16 px); measured once."""
    style: ClassVar[Style] = Style("#666666", "-.", "d")
    steps_shown: ClassVar[tuple[Step, ...]] = (RAW, CALIBRATED)
    """The steps worth a picture, in their order."""
    takes_prior: ClassVar[bool] = False
    """Whether slopes that a loop predicts help it."""
    runs_on_gpu: ClassVar[bool] = False

    # What others ask for ----------------------------------------------------------------------------

    @property
    def required(self) -> frozenset[Need]:
        """What it has to know, as its options are."""
        return self.needs

    @property
    def uses_flux(self) -> bool:
        """Whether it is better for knowing the mean flux, as `faintspot.MeanFlux` finds it."""
        return False

    @property
    def denoises(self) -> bool:
        """Whether it removes noise from the images before it measures them."""
        return False

    def without_denoising(self) -> Estimator | None:
        """Return the same without its denoising; None when it has none."""
        return None

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """Say in one line what it does to each of n sub-apertures of so many pixels."""
        options = ", ".join(f"{name} {self._span(name, n_subapertures, pixels)}" for name in self.chosen())
        return f"{self.method or self.label}{f' ({options})' if options else ''}"

    def for_scene(self, scene: Scene) -> Self:
        """Return the same with the options that follow from a scene alone, before any are tuned."""
        return self

    def for_bright_flux(self) -> Estimator:
        """Return what measures the same in images of plenty of flux and no noise, as for references."""
        return self

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return which options are tuned for a scene, and over which values; the first is the usual one."""
        return {}

    # What a pipeline asks for -----------------------------------------------------------------------

    def prepared(self, sensor: Sensor) -> EstimatorPlan | None:
        """Return what is computed once for a sensor, before the first frame; None: `locate` does the work.

        Raises
        ------
        InputError
            When the options do not fit the sensor.
        """
        return None

    def locate(self, images: NDArray[np.float32], sensor: Sensor, prior: Floats) -> Any:
        """Return the positions of the spots of one frame: what an estimator without a kernel overrides.

        Parameters
        ----------
        images : (n, ny, nx) float32
            Calibrated sub-aperture images, electrons; bad pixels are filled.
        sensor : Sensor
        prior : (n, 2) float64
            Predicted positions, px from the windows' middles.

        Returns
        -------
        array (n, 2) or Positions
            x and y, px from the windows' middles. What is not finite is flagged, never an error.
        """
        raise NotImplementedError(f"{type(self).__name__}: expected an estimator with `locate` or `prepared`")

    def check(self, sensor: Sensor) -> None:
        """Refuse a sensor that lacks what is needed.

        Raises
        ------
        InputError
            When something is missing.
        """
        missing = {
            Need.PSF: sensor.psf is None,
            Need.SCORE: not isinstance(sensor.score, TrainedScore),
            Need.READ_NOISE: sensor.calibration.read_noise_e is None,
            Need.WIDTH: bool(np.isnan(sensor.spot_fwhm_px).any()),
        }
        for need in (need for need in Need if need in self.required):
            if missing[need]:
                wanted = f"estimator {self.name!r}" if need in self.needs else 'settings "auto"'
                raise InputError(f"{need.value} for {wanted}, got none{_MAKERS.get(need, '')}")

    def _span(self, name: str, n_subapertures: int, pixels: int) -> str:
        """Return the values of an option: one, or from which to which."""
        if isinstance(getattr(self, name), str):
            return "automatic" if is_auto(getattr(self, name)) else str(getattr(self, name))
        values = self.values(name, n_subapertures, pixels)
        if values.dtype.kind not in "iuf":
            return ", ".join(dict.fromkeys(str(value) for value in values))
        low, high = values.min(), values.max()
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"


class Positions(NamedTuple):
    """What an estimator in NumPy may return beside positions; each (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.estimators import Positions
    >>> found = Positions(np.array([0.1, 0.0]), np.array([-0.2, 0.0]), valid=np.array([True, False]))
    >>> found.valid
    array([ True, False])
    """

    x: NDArray[Any]
    y: NDArray[Any]
    flux: NDArray[Any] | None = None
    """Electrons. Default: the sum of the image."""
    standard_error_x: NDArray[Any] | None = None
    standard_error_y: NDArray[Any] | None = None
    valid: NDArray[np.bool_] | None = None


class EstimatorPlan:
    """What an estimator has computed for one sensor, in the form that its kernel reads.

    Parameters
    ----------
    estimator : Estimator
    sensor : Sensor
    """

    kernel: Any = None
    """Compiled function that measures groups of sub-apertures: see `faintspot.kernels.groups`."""
    setting_rows: int = COMMON_ROWS
    """Of the table of settings."""
    needs_flux: bool = False
    """Whether the flux must be measured in every frame."""
    flux_kernel: Any = staticmethod(flux_of_groups)
    """Compiled function that measures it."""
    flux_step: float = 1.02
    """Measured flux counts in steps of this factor, so that settings vary slowly."""
    prior_weight_row: int | None = None
    """Of the table of settings: 1 / prior_std_px^2, for a prior whose width may change between frames."""
    in_python: bool = False
    """Whether the kernel only calibrates the images, and `locate_frame` finds the positions."""
    fewer_lanes_are_faster: bool = False
    """Whether a group that is not full is measured faster with a narrower vector."""
    variance: float
    """Of a dark pixel, electrons squared."""
    faults: int = 0
    """Number of frames in which an estimator in NumPy has failed."""
    fault: str = ""
    """Error of the last one, in one line."""

    def __init__(self, estimator: Estimator, sensor: Sensor) -> None:
        self.estimator, self.sensor = estimator, sensor
        self.variance = sensor.variance

    def each(self, name: str) -> NDArray[Any]:
        """Return an option's value for every sub-aperture."""
        return self.estimator.values(name, self.sensor.n, self.sensor.pixels)

    def fill(self, table: NDArray[np.float32]) -> None:
        """Write the estimator's own rows of a table of settings that do not depend on the flux."""

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """Write those that do, for a flux (electrons) of every sub-aperture; NaN where it is not known."""

    def locate_frame(
        self,
        images: NDArray[np.float32],
        prior: NDArray[np.float32],
        table: NDArray[np.float32],
        frame: int,
        slopes: Any,
    ) -> None:
        """Write the slopes of one frame where `in_python`; see `faintspot.estimators.python.PythonPlan`."""
        raise NotImplementedError

    @property
    def tables(self) -> Any:
        """What the kernel reads beside the settings: a NamedTuple."""
        raise NotImplementedError

    @property
    def own_scratch(self) -> Any:
        """Function that makes the kernel's own memory; always the same one while `tables` stay."""
        raise NotImplementedError


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
