"""Poisson numbers of any mean, by exact methods.

Below a mean of 10 by inversion: the probabilities are added up until they exceed a uniform number, in double
precision, so that of 10^15 numbers about one is off. From 10 on by Hörmann's transformed rejection (PTRS,
1993, Insurance: Mathematics and Economics 12, 39), whose acceptance test is exact, too. There is no Gaussian
approximation at any mean.
"""

from __future__ import annotations

import math
from typing import Any

from numba import float64, uint64

from faintspot.cuda.compiling import device
from faintspot.cuda.philox import philox, uniform

_INVERTED_BELOW = 10.0
_MOST_INVERTED = 100.0  # beyond, the probabilities are below 1e-60: the uniform number was rounded to 1


@device
def inverted(mean: Any, chance: Any) -> Any:
    """The number at which the cumulative distribution exceeds `chance`."""
    count, probability = float64(0.0), math.exp(-mean)
    total = probability
    while chance > total and count < _MOST_INVERTED:
        count += 1.0
        probability *= mean / count
        total += probability
    return count


@device
def rejected(mean: Any, pixel: Any, image: Any, purpose: Any, key_0: Any, key_1: Any) -> Any:
    """A number by transformed rejection; every attempt has a counter of its own."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    squeeze = 0.9277 - 3.6224 / (b - 2.0)
    count, attempt, accepted = float64(0.0), uint64(0), False
    while not accepted:
        w0, w1, w2, w3 = philox(pixel, image, attempt, purpose, key_0, key_1)
        attempt += uint64(1)
        away, v = uniform(w0, w1) - 0.5, uniform(w2, w3)
        near = 0.5 - abs(away)
        count = math.floor((2.0 * a / near + b) * away + mean + 0.43)
        if near >= 0.07 and v <= squeeze:
            accepted = True
        elif count >= 0.0 and (near >= 0.013 or v <= near):
            chance = math.log(v * inverse_alpha / (a / (near * near) + b))
            accepted = chance <= count * math.log(mean) - mean - math.lgamma(count + 1.0)
    return count


@device
def poisson(mean: Any, pixel: Any, image: Any, purpose: Any, key_0: Any, key_1: Any) -> Any:
    """Electrons, float64, of a pixel with this mean; the other arguments are counter and key."""
    if mean <= 0.0:
        return float64(0.0)
    if mean >= _INVERTED_BELOW:
        return rejected(mean, pixel, image, purpose, key_0, key_1)
    w0, w1, _, _ = philox(pixel, image, uint64(0), purpose, key_0, key_1)
    return inverted(mean, uniform(w0, w1))
