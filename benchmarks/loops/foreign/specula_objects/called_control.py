"""Any control in SPECULA, with a record of slopes and commands."""

from typing import Any

import numpy as np

from benchmarks.loops.foreign.base import Control, Floats
from faintspot.adapters.specula.faintspot_control import FaintspotControl

CONTROLS: list[Control] = []
"""The latest is used: a parameter file cannot name a function."""


class CalledControl(FaintspotControl):
    """Control that was put into `CONTROLS`."""

    def __init__(self, nmodes: int, delay: int = 0, **options: Any) -> None:
        super().__init__(self._recorded, nmodes, delay, **options)
        self._control = CONTROLS[-1]
        self.slopes: list[Floats] = []
        self.commands: list[Floats] = []
        self.predicting: list[float] = []

    def _recorded(self, slopes: Floats) -> Floats:
        self.predicting.append(float(getattr(self._control, "is_predicting", False)))
        self.slopes.append(slopes.copy())
        self.commands.append(np.array(self._control(slopes)))
        return self.commands[-1]
