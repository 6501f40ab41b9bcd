"""Cells of a study, each one set of physical parameters, and sweeps, which list them."""

import hashlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.base.options import LIST, Option
from faintspot.slopes.camera.detector import Detector

PROFILES = ("diffraction", "gaussian")


RANGES = {
    "flux_e": Option("", "electron", 0.0, 1e9, low_open=True),
    "read_noise_e": Option("", "electron", 0.0, 1e6),
    "size": Option("", "2 px", 0.05, 1e3),
    "elongation": Option("", "1", 1.0, 100.0),
    "pixels": Option("", "px", 4, 64, whole=True),
    "position_range_px": Option("", "px", 0.0, 32.0, low_open=True),
    "background_e": Option("", "electron", 0.0, 1e6),
    "em_gain": Option("", "1", 1.0, 1e5),
    "d_over_r0": Option("", "1", 0.0, 10.0),
}
"""The numeric parameters of a `Cell`, which says what they mean; `profile` is the only other one."""


@dataclass(frozen=True)
class Cell:
    """One point of a study: what is simulated.

    Parameters
    ----------
    flux_e : float
        Electrons that a spot in the middle of its window leaves within it.
    read_noise_e : float
        Standard deviation of the read noise, in photo-electrons (after multiplication: divided by its gain).
    profile : {"diffraction", "gaussian"}
    size : float
        Width of the spot in units of 2 px, see `faintspot.slopes.spots.shapes`.
    elongation : float
        Factor on the width along x.
    pixels : int
        Side of the square sub-aperture, px.
    position_range_px : float
        True positions are uniform within plus and minus this on each axis.
    background_e : float
        Mean electrons per pixel, whose mean is subtracted and whose noise stays.
    em_gain : float
        Gain of an electron-multiplying register; 1 is a detector without one.
    d_over_r0 : float
        Side of the sub-aperture in units of the Fried parameter: above 0 turbulence speckles the spots, see
        `faintspot.slopes.simulate.subapertures`.

    Examples
    --------
    >>> from faintspot.experiments import Sweep
    >>> cell = list(Sweep("light", flux_e=[30, 100], pixels=8).cells())[0]
    >>> cell.flux_e, cell.pixels, round(cell.pixel_noise_e, 2)
    (30.0, 8, 0.69)
    """

    flux_e: float
    read_noise_e: float
    profile: str
    size: float
    elongation: float
    pixels: int
    position_range_px: float
    background_e: float
    em_gain: float
    d_over_r0: float = 0.0

    @property
    def excess_noise(self) -> float:
        """Factor of the multiplication register on the photon noise's variance."""
        return 2.0 if self.em_gain > 1 else 1.0

    @property
    def pixel_noise_e(self) -> float:
        """Standard deviation of a mean pixel's noise: read noise and the flux's, spread over all pixels."""
        flux = self.flux_e / self.pixels**2 + self.background_e
        return float(np.sqrt(self.read_noise_e**2 + self.excess_noise * flux))

    @property
    def detector(self) -> Detector:
        """The camera."""
        return Detector(
            self.read_noise_e * self.em_gain, background_e=self.background_e, em_gain=self.em_gain
        )

    @property
    def conditions(self) -> dict[str, Any]:
        """Window, spots and camera by the names that simulations and bounds give them."""
        names = ("profile", "size", "elongation", "position_range_px", "detector")
        return {"shape": (self.pixels, self.pixels), **{name: getattr(self, name) for name in names}}

    def seed(self, study_seed: int) -> np.random.SeedSequence:
        """Return the cell's own seed, from the study's seed and its coordinates alone."""
        values = asdict(self)
        if self.d_over_r0 == 0:
            del values["d_over_r0"]  # cells without turbulence keep the seeds they had before it was known
        coordinates = ";".join(f"{name}={value!r}" for name, value in values.items())
        words = np.frombuffer(hashlib.sha256(coordinates.encode()).digest(), "<u4")
        return np.random.SeedSequence([study_seed, *(int(word) for word in words)])


PARAMETERS = tuple(field.name for field in fields(Cell))


@dataclass(frozen=True)
class Sweep:
    """Every combination of the values that are listed for each parameter.

    Parameters
    ----------
    name : str
    flux_e, read_noise_e, profile, size, elongation, pixels, position_range_px, background_e, em_gain, \
    d_over_r0
        A value or a sequence of values each, see `Cell`.

    Raises
    ------
    InputError
        For a value out of its range, an empty sequence, an unknown profile, turbulence with other spots than
        round ones of profile "diffraction".

    Examples
    --------
    >>> from faintspot.experiments import Sweep
    >>> sweep = Sweep("light", flux_e=[30, 100, 300], read_noise_e=[0.1, 3.0], pixels=8)
    >>> sweep.n_cells
    6
    """

    name: str
    flux_e: Any = 100.0
    read_noise_e: Any = 0.1
    profile: object = "diffraction"
    size: Any = 1.0
    elongation: object = 1.0
    pixels: Any = 16
    position_range_px: Any = 1.0
    background_e: Any = 0.0
    em_gain: Any = 1.0
    d_over_r0: Any = 0.0

    def __post_init__(self) -> None:
        for name in PARAMETERS:
            checked = _values(f"sweep {self.name!r}: {name}", name, getattr(self, name))
            object.__setattr__(self, name, checked)
        if any(self.d_over_r0) and (self.profile != ("diffraction",) or self.elongation != (1.0,)):
            raise InputError(
                f"sweep {self.name!r}: d_over_r0 = {max(self.d_over_r0):g}: expected profile 'diffraction' "
                f"and elongation 1"
            )

    @property
    def n_cells(self) -> int:
        """Number of combinations."""
        return math.prod(len(getattr(self, name)) for name in PARAMETERS)

    def cells(self) -> list[Cell]:
        """Return the cells, the last parameter varying fastest."""
        return [Cell(*values) for values in itertools.product(*(getattr(self, name) for name in PARAMETERS))]


STANDARD: dict[str, Any] = {item.name: item.default for item in fields(Sweep) if item.name in PARAMETERS}
"""Values of parameters that a sweep does not list."""


def _values(where: str, name: str, values: Any) -> tuple[Any, ...]:
    """Return the values of a parameter, checked, each once and in the order given."""
    items: Sequence[Any] = [values] if isinstance(values, str) or np.ndim(values) == 0 else list(values)
    if not items:
        raise InputError(f"{where}: expected at least one value, got an empty list")
    if name == "profile":
        return tuple(dict.fromkeys(one_of(where, item, PROFILES) for item in items))
    return tuple(dict.fromkeys(replace(RANGES[name], kind=LIST).checked(where, items)))
