"""Validity of slopes, and the line that names those a result leaves out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.flags import INVALID, KEEPABLE, NO_FLAG, SubapertureFlag

_CAUSES = {
    "dark": SubapertureFlag.NO_FLUX,
    "bad pixels": SubapertureFlag.TOO_MANY_BAD_PIXELS,
    **KEEPABLE,
}


def are_valid(flags: NDArray[Any], keep: SubapertureFlag = NO_FLAG) -> NDArray[np.bool_]:
    """Return which slopes no flag of `INVALID` marks; those in `keep` do not count."""
    return (flags & int(INVALID & ~keep)) == 0  # type: ignore[no-any-return]


def leave_out(
    flags: NDArray[Any],
    keep: SubapertureFlag = NO_FLAG,
    others: Mapping[str, NDArray[np.bool_]] | None = None,
) -> tuple[NDArray[np.bool_], str]:
    """Return which slopes to use, and a line about the others; it is empty if there are none.

    Parameters
    ----------
    flags : (n,) or (n_frames, n) array of int
        Bits of `SubapertureFlag`.
    keep : SubapertureFlag
        Flags of `KEEPABLE` that do not make a slope invalid.
    others : dict of str to array of bool, optional
        Further causes, each with the slopes to leave out; arrays of a shape that broadcasts to that of
        `flags`.

    Returns
    -------
    array of bool, str

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.base.validity import leave_out
    >>> leave_out(np.array([[0, 1, 128], [0, 1, 0]], np.uint8))
    (array([[ True, False, False],
           [ True, False,  True]]), 'left out 1 of 3 sub-apertures, 1 slope of others: dark, limited')
    """
    causes = {word: (flags & int(flag & ~keep)) != 0 for word, flag in _CAUSES.items()}
    causes |= {word: np.broadcast_to(mask, flags.shape) for word, mask in (others or {}).items()}
    counts = {word: int(np.count_nonzero(mask)) for word, mask in causes.items()}
    invalid = np.logical_or.reduce(list(causes.values()))
    rows = invalid.reshape(-1, flags.shape[-1])
    never: NDArray[np.bool_] = np.logical_and.reduce(rows)
    single, parts = int(np.count_nonzero(rows[:, ~never])), []
    if never.any():
        parts.append(f"{np.count_nonzero(never)} of {len(never)} sub-apertures")
    if single:
        rest = "of others" if never.any() else f"of {rows.size}"
        parts.append(f"{single} {'slope' if single == 1 else 'slopes'} {rest}")
    if not parts:
        return ~invalid, ""
    words = [word for word in sorted(counts, key=lambda word: -counts[word]) if counts[word]]
    return ~invalid, f"left out {', '.join(parts)}: {', '.join(words)}"
