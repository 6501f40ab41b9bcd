"""Layouts of telemetry that observatories and benches write, as public readers describe them.

The facts are from https://github.com/STAR-PORT/aotpy (translators of ESO's SPARTA tables of CIAO, NAOMI,
ERIS and GPAO, and of Keck's save files), https://github.com/soylentdeen/Graffity (CIAO), public scripts that
read SPHERE's VisLoopRecorder files, https://github.com/astro-tiptop/P3 (units of Keck's),
https://github.com/aditya-sengupta/tip-tilt-control (its tip and tilt) and https://github.com/rjonnal/ciao.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_KECK_TICK_S = 1e-7


@dataclass(frozen=True, kw_only=True)
class TelemetryLayout:
    """Where a kind of files has the quantities of a loop.

    Names are those of columns, fields or files; capitals do not count. They may be patterns with *, and
    alternatives with |.
    """

    name: str
    slopes: tuple[str, ...]
    """Arrays (frames, ...), side by side; a file of this kind has all of them."""
    columns: tuple[int | None, int | None] = (None, None)
    """First of their columns that are slopes, and the one after the last."""
    commands: tuple[str, ...] = ()
    """Arrays (frames, commands), side by side, of which some may be absent."""
    interaction: tuple[str, ...] = ()
    """Interaction matrix of each of these, in the file or in a file beside it."""
    identity: bool = False
    """Whether commands have the axes and the unit of the slopes."""
    control: str = ""
    """Control matrix, in rows for all commands, in the file or beside it; further rows follow."""
    cells: str = ""
    frame: str = ""
    time_s: Mapping[str, float] = field(default_factory=dict)
    """Arrays whose sum is the time, and the seconds in their units."""
    rate: str = ""
    """Frame rate [Hz] in the header."""
    closed: str = ""
    """State of the loop in the header."""
    law: str = ""
    """Keyword or array that describes the control law."""
    known: Mapping[str, Any] = field(default_factory=dict)
    """Values that all files of this kind have: slope_order, slope_unit, subaperture_m, cells."""


def _keck_cells() -> NDArray[np.int64]:
    """Return the mask of the 304 sub-apertures of Keck's sensor."""
    mask = np.zeros((20, 20), np.int64)
    for row, width in enumerate((6, 10, 14, 16, 16, 18, 18, 20, 20, 20)):
        mask[[row, 19 - row], 10 - width // 2 : 10 + width // 2] = 1
    mask[8:12, 9:11] = mask[9:11, 8:12] = 0  # the secondary mirror
    return mask


LAYOUTS: tuple[TelemetryLayout, ...] = (
    TelemetryLayout(
        name="SPARTA table",
        slopes=("Gradients",),
        # CIAO and SPHERE, with the tip-tilt mirror; ERIS; GPAO; NAOMI, whose matrix is that of modes; others
        commands=(
            "HODM_Positions|DSM_Positions|DM_Positions|ModalCoefficients|*_Positions|Positions",
            "ITTM_Positions",
        ),
        interaction=("*HO_IM*|*SynthIMComp.IM*|ModalRecnCalibrat.REF_IM*|*SYNTHETIC_*IM*", "*ITT_IM*"),
        control="*REC1.CM*|*REC1.HOCM*",
        frame="FrameCounter",
        time_s={"Seconds": 1.0, "USeconds": 1e-6},
        rate="ESO AOS LOOP RATE",
        closed="ESO AOS HO LOOP ST|ESO AOS LOOP ST",
        law="ESO AOS GLOBAL GAIN",
        known={"slope_order": "pairs"},
    ),
    TelemetryLayout(
        name="Keck save file, high order",
        slopes=("A.OFFSETCENTROID",),
        commands=("A.DMCOMMAND", "A.TTCOMMANDS"),
        control="RX",
        time_s={"A.TIMESTAMP": _KECK_TICK_S},
        law="DM_SERVO",
        known={
            "slope_order": "pairs",
            "slope_unit": "px",
            "subaperture_m": 0.5625,
            "cells": _keck_cells(),
        },
    ),
    TelemetryLayout(
        name="Keck save file, tip-tilt sensor",
        slopes=("B.DTTCENTROIDS",),
        commands=("B.DTTCOMMANDS",),
        identity=True,
        time_s={"B.TIMESTAMP": _KECK_TICK_S},
        law="DT_SERVO",
    ),
    TelemetryLayout(
        name="Keck save file, tip and tilt of the wavefront sensor",
        slopes=("A.RESIDUALWAVEFRONT",),
        columns=(-3, -1),  # after the actuators and before focus
        commands=("A.TTCOMMANDS",),
        identity=True,
        time_s={"A.TIMESTAMP": _KECK_TICK_S},
        law="DT_SERVO",
        known={"slope_unit": "arcsec"},
    ),
    TelemetryLayout(
        name="folder of ciao",
        slopes=("x_slopes", "y_slopes"),
        commands=("commands",),
        interaction=("*poke*",),
        cells="*mask*",
        time_s={"time_s": 1.0},
        known={"slope_unit": "rad"},
    ),
    TelemetryLayout(
        name="folder of arrays",
        slopes=("slopes",),
        interaction=("interaction_matrix|*poke*",),
        commands=("commands",),
        control="control_matrix",
        cells="cells|*mask*",
        frame="frame",
        time_s={"time_s": 1.0},
    ),
)
"""Known layouts; no two have the same slopes."""
