"""Alternating observations: one row for each block of frames that one method measured."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import output_errors
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_zarr

Floats = NDArray[np.float64]

NIGHT_STORE = "night.zarr"
"""Name of the store in a folder of results."""
_FORMAT = 1
_AXIS = "block"


@dataclass(frozen=True, eq=False)
class Night:
    """Blocks of a night in the order of time; arrays are (B,) unless stated otherwise. NaN: not known.

    A block is a stretch of frames that one method measured, without the frames in which the loop settled.
    Sets are stretches of the night with the same conditions, such as the multiplication gain of the camera.
    """

    labels: tuple[str, ...]
    """(M,): names of the methods."""
    settings: tuple[str, ...]
    """(M,): settings of each method in words, loop gain included."""
    reference: int
    """Number of the method that the others are compared with."""
    set_names: tuple[str, ...]
    """(S,)"""
    set_number: NDArray[np.int64]
    """Index into set_names."""
    method: NDArray[np.int64]
    """Index into labels."""
    strength: Floats
    """Strength of TV in `strength_unit`; NaN for methods without one."""
    start_s: Floats
    """First scored frame of the block, from the beginning of the night."""
    duration_s: Floats
    """Duration of the scored frames."""
    strehl: Floats
    """Long-exposure Strehl ratio of the block."""
    strehl_error: Floats
    """Standard error of `strehl` by measurement alone, without what the turbulence adds between blocks."""
    phase_rad2: Floats
    """Residual phase variance at the science wavelength, mean over the block."""
    phase_error_rad2: Floats
    """Standard error of `phase_rad2`, as for `strehl_error`."""
    r0_m: Floats
    """Fried parameter at 500 nm, measured from pseudo-open-loop slopes of the block."""
    r0_error_m: Floats
    true_r0_m: Floats
    """Fried parameter at 500 nm in a simulation."""
    paired_strehl: Floats
    """Strehl ratio of the reference in the same turbulence at the same time, in a simulation."""
    overhead_s: float
    """Time lost for each block by changing the method and settling."""
    wavelength_m: float
    """Science wavelength of Strehl ratio and phase."""
    source: str
    """Source of the blocks: "simulated" or a file."""
    configuration: str
    """TOML text of the simulated configuration, or ""."""
    strength_unit: str = "e-"
    """"e-": photo-electrons, or "counts" of the camera."""
    counts_per_e: Floats | None = None
    """Counts of the camera for a photo-electron, where they are known."""
    shared_error: Floats | None = None
    """Standard error of `strehl`, against that of the reference, that blocks of a method have in common."""

    def __post_init__(self) -> None:
        count = len(self.start_s)
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and value.shape != (count,):
                raise InputError(
                    f"{item.name}: expected a value for each of {count} blocks, got {value.shape}"
                )
        for name, numbers, limit in (
            ("method", self.method, len(self.labels)),
            ("set_number", self.set_number, len(self.set_names)),
        ):
            if count and not (numbers.min() >= 0 and numbers.max() < limit):
                raise InputError(f"{name}: expected numbers from 0 to {limit - 1}")
        if not 0 <= self.reference < len(self.labels):
            raise InputError(f"reference: expected 0 to {len(self.labels) - 1}, got {self.reference}")

    @property
    def middle_s(self) -> Floats:
        """(B,): middle of each block, from the beginning of the night."""
        return self.start_s + self.duration_s / 2

    @property
    def hours(self) -> float:
        """Duration of the observations, settling included."""
        return float((self.duration_s + self.overhead_s).sum()) / 3600

    @property
    def has_strengths(self) -> bool:
        """Whether there are blocks with TV."""
        return bool((self.strength > 0).any())

    @property
    def is_paired(self) -> bool:
        """Whether the reference is known in the same turbulence."""
        return bool(np.isfinite(self.paired_strehl).any())

    @property
    def cycle(self) -> NDArray[np.int64]:
        """(B,): number of the cycle, which begins with each block of the reference and each set."""
        new_set = np.diff(self.set_number, prepend=self.set_number[:1] - 1) != 0
        return np.cumsum(new_set | (self.method == self.reference)) - 1

    def save(self, path: str | Path) -> None:
        """Write the night as a Zarr store, which xarray opens with one dimension, `block`.

        Raises
        ------
        InputError
            When it cannot be written.
        MissingExtraError
            When zarr is not installed.
        """
        path, zarr = Path(path), load_zarr()
        hidden = path.with_name(f".{path.name}.new")
        attributes = {
            item.name: list(value) if isinstance(value, tuple) else value
            for item in fields(self)
            if not isinstance(value := getattr(self, item.name), np.ndarray)
        }
        with output_errors(path):
            shutil.rmtree(hidden, ignore_errors=True)
            group = zarr.create_group(
                str(hidden), zarr_format=3, attributes={"night_format": _FORMAT, **attributes}
            )
            for name, values in self._columns().items():
                group.create_array(name, data=values, dimension_names=(_AXIS,))
            shutil.rmtree(path, ignore_errors=True)
            hidden.rename(path)

    def _columns(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays by name."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def load_night(path: str | Path) -> Night:
    """Read what `Night.save` wrote.

    Raises
    ------
    InputError
        When it cannot be read, or is something else.
    MissingExtraError
        When zarr is not installed.
    """
    zarr = load_zarr()
    try:
        group = zarr.open_group(str(path), mode="r")
        attributes = dict(group.attrs)
        columns = {name: np.asarray(array[:]) for name, array in group.arrays()}
    except Exception as error:  # each kind of damage makes zarr raise another error
        raise InputError(f"{path}: cannot be read as a night ({one_line(error)})") from None
    if attributes.pop("night_format", None) != _FORMAT or {*attributes, *columns} != {
        item.name for item in fields(Night)
    }:
        raise InputError(f"{path}: expected a night of format {_FORMAT}, got something else")
    values: dict[str, Any] = {**attributes, **columns}
    for name in ("labels", "settings", "set_names"):
        values[name] = tuple(values[name])
    return Night(**values)
