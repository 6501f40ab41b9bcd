"""Independent random generators, one for each source of randomness, spawned from the caller's."""

from __future__ import annotations

import numpy as np

from faintspot.base.errors import InputError


def spawn(rng: object, count: int) -> list[np.random.Generator]:
    """Return `count` independent generators spawned from `rng`.

    With separate generators, switching one source of randomness on or off does not change the draws of the
    others. Spawning does not advance the caller's stream, but a second call gives different children.

    Parameters
    ----------
    rng : numpy.random.Generator or None
        Parent generator; None uses fresh entropy from the operating system.
    count : int
        Number of generators.

    Returns
    -------
    list of numpy.random.Generator

    Raises
    ------
    InputError
        If `rng` is neither None nor a generator that can spawn.
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
