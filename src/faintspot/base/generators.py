"""One random generator for each source of randomness, all from the caller's."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.errors import InputError


def spawn(rng: Any, count: int) -> list[np.random.Generator]:
    """Return `count` independent generators spawned from `rng`.

    Sources that draw from generators of their own do not change each other's draws when one of them is
    switched on or off. Spawning does not consume the caller's stream, but spawning again from the same
    generator gives other children.

    Parameters
    ----------
    rng : numpy.random.Generator or None
        The caller's generator; None takes fresh entropy from the operating system.
    count : int
        How many generators.

    Returns
    -------
    list of numpy.random.Generator

    Raises
    ------
    InputError
        When `rng` is neither None nor a generator that can spawn.
    """
    if rng is None:
        rng = np.random.default_rng()
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng: expected a numpy.random.Generator or None, got {type(rng).__name__}")
    try:
        return rng.spawn(count)
    except TypeError:
        raise InputError(
            "rng: expected a generator that can spawn, such as numpy.random.default_rng(seed)"
        ) from None
