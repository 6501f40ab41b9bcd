"""The slope error against the flux: how many magnitudes a method gains, and how faint a star may be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintspot.study.metric import Estimate, flux_gain

Floats = NDArray[np.float64]

_DRAWS = 40
_MAGNITUDE = 2.5 / math.log(10)


@dataclass(frozen=True, eq=False)
class Curve:
    """Errors of the same spots at several fluxes."""

    flux_e: Floats
    """(m,), increasing."""
    errors_px: Floats
    """(m, n): (|dx| + |dy|) / 2 of each spot."""

    @cached_property
    def error_px(self) -> Floats:
        """R at each flux."""
        return self.errors_px.mean(axis=1)  # type: ignore[no-any-return]

    @cached_property
    def standard_error_px(self) -> Floats:
        """Standard error of R at each flux."""
        return self.errors_px.std(axis=1) / math.sqrt(self.errors_px.shape[1])  # type: ignore[no-any-return]


def magnitude_gain(plain: Curve, method: Curve, at: int, rng: np.random.Generator) -> Estimate:
    """Return how many magnitudes fainter a star may be with a method for R of the plain one at a flux.

    The standard error comes from curves drawn within the errors of both, which go together as they share
    their spots.

    Returns
    -------
    Estimate
        Infinite where the method's R is smaller on its whole curve, minus infinity where it is larger.
    """
    flux = plain.flux_e
    if plain is method:
        return Estimate(0.0, 0.0)
    value = flux_gain(flux, plain.error_px, method.error_px, flux[at])
    if math.isnan(value):
        better = method.error_px.max() <= plain.error_px[at]
        return Estimate(math.inf if better else -math.inf, math.nan)
    drawn = [flux_gain(flux, first, second, flux[at]) for first, second in _drawn_pairs(plain, method, rng)]
    return _in_magnitudes(value, drawn)


def limiting_flux(curve: Curve, budget_px: float, rng: np.random.Generator) -> Estimate:
    """Return the flux at which R equals a budget.

    Returns
    -------
    Estimate
        0 where R is below the budget on the whole curve, infinite where it is above.
    """
    if curve.error_px.min() > budget_px:
        return Estimate(math.inf, math.nan)
    if curve.error_px[0] <= budget_px:
        return Estimate(0.0, math.nan)
    flux = curve.flux_e
    level = np.full(len(flux), budget_px)  # a method whose error is the budget at any flux
    first = flux[0]
    values = [curve.error_px] + [second for _, second in _drawn_pairs(curve, curve, rng)]
    found = np.array([first / flux_gain(flux, level, value, first) for value in values])
    known = found[1:][np.isfinite(found[1:])]
    return Estimate(float(found[0]), float(known.std()) if len(known) > 1 else math.nan)


def _drawn_pairs(first: Curve, second: Curve, rng: np.random.Generator) -> list[tuple[Floats, Floats]]:
    """Draw pairs of curves from the means' normal distribution."""
    n = first.errors_px.shape[1]
    own, common = first.standard_error_px, np.zeros(len(first.flux_e))
    for index, (a, b) in enumerate(zip(first.errors_px, second.errors_px, strict=True)):
        common[index] = float(np.mean((a - a.mean()) * (b - b.mean()))) / n
    variance = np.square(second.standard_error_px)
    along = np.divide(common, own, where=own > 0, out=np.zeros_like(common))
    across = np.sqrt(np.maximum(variance - along**2, 0.0))
    pairs = []
    for _ in range(_DRAWS):
        z, w = rng.standard_normal((2, len(own)))
        pairs.append(
            (
                np.maximum(first.error_px + own * z, 1e-9),
                np.maximum(second.error_px + along * z + across * w, 1e-9),
            )
        )
    return pairs


def _in_magnitudes(ratio: float, drawn: list[float]) -> Estimate:
    known = np.array([value for value in drawn if math.isfinite(value)])
    error = float(_MAGNITUDE * np.log(known).std()) if len(known) > 1 else math.nan
    return Estimate(_MAGNITUDE * math.log(ratio), error)
