"""Results of closed-loop experiments: their files, and comparisons with errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.npz import NpzFile
from faintspot.base.statistics import Estimate, paired_mean
from faintspot.experiments.closed_loop.limits import magnitude_gain

Floats = NDArray[np.float64]
_STREHL_LEVELS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(NpzFile):
    """Strehl ratio against the star's flux: A methods, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 4

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.closed_loop.methods.method_kind`."""
    labels: tuple[str, ...]
    """(A,)"""
    photons: Floats
    """(F,): photo-electrons of a fully lit sub-aperture in a frame."""
    magnitudes: Floats
    """(F,)"""
    strehl: Floats
    """(A, F, R): long exposure; NaN where not measured yet."""
    centroid_gain: Floats
    """(A, F, R)"""
    settings: NDArray[np.str_]
    """(A, F): TOML text of the tuned settings; "" where not tuned yet."""
    choices: NDArray[np.str_]
    """(A, F): JSON text of the tuned values, loop gain included; "{}" where not tuned yet."""
    configuration: str
    """TOML text."""


@dataclass(frozen=True, eq=False)
class BudgetResult(NpzFile):
    """Error budget: A methods with T terms switched off, R realisations of the air."""

    WHAT: ClassVar[str] = "an error budget"
    FORMAT: ClassVar[int] = 2

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.closed_loop.methods.method_kind`."""
    terms: tuple[str, ...]
    """(T,): what is switched off; the first is nothing."""
    labels: tuple[str, ...]
    """(A,)"""
    strehl: Floats
    """(A, T, R): long exposure; NaN where not measured yet."""
    residual_nm: Floats
    """(A, T, R): rms of the wavefront after the mirror, root of the mean square over the frames."""


def differences_by_flux(result: MagnitudeResult, method: int, reference: int) -> list[Estimate]:
    """Return a method's Strehl less the reference's at each flux, over realisations.

    The intervals hold together, for all fluxes, with 95 %.
    """
    fluxes = len(result.photons)
    return [
        paired_mean(result.strehl[method, f] - result.strehl[reference, f], fluxes) for f in range(fluxes)
    ]


def gains_in_magnitude(result: MagnitudeResult, method: int, reference: int) -> dict[float, Estimate]:
    """Return the gain in limiting magnitude at each Strehl ratio that the reference's curve passes."""
    curve = np.array([paired_mean(values).value for values in result.strehl[reference]])
    finite = curve[np.isfinite(curve)]
    return {
        level: magnitude_gain(
            result.magnitudes, result.strehl[method], result.strehl[reference], level
        ).estimate
        for level in _STREHL_LEVELS
        if len(finite) and finite.min() < level <= finite.max()
    }
