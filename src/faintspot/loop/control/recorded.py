"""Control of an engine in its recordings: the interaction matrix and the options."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.control.configuration import INTERACTION, Control
from faintspot.loop.control.options import TABLE, ControlOptions

_MOST_BYTES = 1 << 20
_SHAPE, _TYPE = "shape", "<f4"


class RecordedControl(NamedTuple):
    """Control as a recording describes it."""

    interaction: NDArray[np.float64]
    """(2 n, commands): slopes [px] that one unit of each command adds."""
    options: ControlOptions


def packed_control(control: Control | None) -> dict[str, Any] | None:
    """Return matrix and options as JSON values; None without control, or if they exceed 1 MiB."""
    if control is None or control.interaction.size * np.dtype(_TYPE).itemsize > _MOST_BYTES:
        return None
    text = base64.b64encode(control.interaction.astype(_TYPE).tobytes()).decode()
    return {INTERACTION: text, _SHAPE: list(control.interaction.shape), **control.options.chosen()}


def unpacked_control(attributes: Mapping[str, Any]) -> RecordedControl | None:
    """Return the control from the attributes of a recording; None where it is not recorded.

    Raises
    ------
    InputError
        When it is damaged.
    """
    if not attributes.get(TABLE):
        return None
    try:
        options = dict(attributes[TABLE])
        values = np.frombuffer(base64.b64decode(options.pop(INTERACTION), validate=True), _TYPE)
        matrix = values.reshape(options.pop(_SHAPE)).astype(np.float64)
        return RecordedControl(matrix, ControlOptions(**options))
    except (KeyError, TypeError, ValueError) as error:  # InputError is a ValueError
        raise InputError(f"{TABLE}: the recorded control is damaged ({error})") from None
