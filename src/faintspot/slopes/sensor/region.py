"""Regions of a frame given by the user: pupil and rectangle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError


@dataclass(frozen=True)
class PupilRegion:
    """Disk or annulus on the detector: centre x + 1j * y, outer and inner radius [px]."""

    centre: complex
    radius: float
    inner: float

    @classmethod
    def given(cls, value: object) -> PupilRegion:
        """Return the region (x, y, radius) or (x, y, radius, inner radius); raise InputError if invalid."""
        numbers = numbers_between("pupil", value)
        if numbers.ndim != 1 or len(numbers) not in (3, 4):
            raise InputError("pupil: expected x, y, radius and, for an annulus, the inner radius, in pixels")
        x, y, radius, inner = (float(number) for number in np.append(numbers, 0.0)[:4])
        if not radius > inner >= 0:
            raise InputError(f"pupil: expected radius > inner radius >= 0, got {radius:g} and {inner:g}")
        return cls(complex(x, y), radius, inner)

    def moved(self, step: complex) -> PupilRegion:
        """Return the region moved by x + 1j * y."""
        return replace(self, centre=self.centre + step)

    def holds(self, at: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Return which positions x + 1j * y are inside."""
        distance = np.abs(at - self.centre)
        return np.asarray((distance <= self.radius) & (distance >= self.inner))


@dataclass(frozen=True)
class Rectangle:
    """Columns x0 to x1 - 1 and rows y0 to y1 - 1 of a frame."""

    x0: int
    y0: int
    x1: int
    y1: int

    @classmethod
    def given(cls, value: object, shape: tuple[int, ...]) -> Rectangle:
        """Return the rectangle (x0, y0, x1, y1), or the frame for None; raise InputError if outside."""
        if value is None:
            return cls(0, 0, shape[1], shape[0])
        numbers = numbers_between("roi", value, integer=True)
        if numbers.shape != (4,):
            raise InputError("roi: expected x0, y0, x1, y1 in pixels")
        x0, y0, x1, y1 = (int(number) for number in numbers)
        if not (0 <= x0 < x1 <= shape[1] and 0 <= y0 < y1 <= shape[0]):
            raise InputError(
                f"roi = {x0}, {y0}, {x1}, {y1}: expected x0 < x1 and y0 < y1 within the frame's {shape[1]} "
                f"columns and {shape[0]} rows"
            )
        return cls(x0, y0, x1, y1)

    @property
    def slices(self) -> tuple[EllipsisType, slice, slice]:
        """Slices that cut the rectangle out of one or several frames."""
        return (..., slice(self.y0, self.y1), slice(self.x0, self.x1))
