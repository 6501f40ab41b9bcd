"""Random numbers from counters: the same counter and key give the same numbers, whoever asks and when.

Philox-4x32-10 of Salmon, Moraes, Dror & Shaw 2011 ("Parallel random numbers: as easy as 1, 2, 3", SC11).
"""

from __future__ import annotations

import math
from typing import Any

from numba import float32, float64, uint64

from faintspot.cuda.compiling import device

_MULTIPLIER_0, _MULTIPLIER_1 = 0xD2511F53, 0xCD9E8D57
_BUMP_0, _BUMP_1 = 0x9E3779B9, 0xBB67AE85
_WORD = 0xFFFFFFFF
_ROUNDS = 10


@device
def philox(a: Any, b: Any, c: Any, d: Any, key_0: Any, key_1: Any) -> Any:
    """Four random words of 32 bits from a counter (a, b, c, d) and a key, all held in uint64."""
    word, half = uint64(_WORD), uint64(32)
    for _ in range(_ROUNDS):
        left, right = uint64(_MULTIPLIER_0) * a, uint64(_MULTIPLIER_1) * c
        a, c = (right >> half) ^ b ^ key_0, (left >> half) ^ d ^ key_1
        b, d = right & word, left & word
        key_0 = (key_0 + uint64(_BUMP_0)) & word
        key_1 = (key_1 + uint64(_BUMP_1)) & word
    return a, b, c, d


@device
def uniform(high: Any, low: Any) -> Any:
    """A number strictly between 0 and 1 from two words, on a grid of 2^-52."""
    whole = (high << uint64(20)) | (low >> uint64(12))
    return (float64(whole) + 0.5) * (2.0**-52)


@device
def normal(a: Any, b: Any) -> Any:
    """A normal number from two words (Box & Muller 1958); none is beyond 6.8 standard deviations."""
    radius = math.sqrt(float32(-2.0) * math.log((float32(a) + float32(0.5)) * float32(2.0**-32)))
    return radius * math.cos(float32(b) * float32(2.0 * math.pi * 2.0**-32))
