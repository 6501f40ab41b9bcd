"""Predictive control in SPECULA, in place of its reconstructor and integrator."""

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import check_version
from faintspot.adapters.specula.faintspot_slopec import TESTED
from faintspot.base.checks import number_between
from faintspot.base.errors import MissingExtraError
from faintspot.loop.control import PredictiveControl

try:
    from specula import cpuArray
    from specula.base_processing_obj import BaseProcessingObj, InputDesc, OutputDesc
    from specula.base_value import BaseValue
    from specula.connections import InputValue
    from specula.data_objects.slopes import Slopes
except ImportError:
    raise MissingExtraError("specula", "specula", "faintspot.adapters.specula") from None

_MOST_DELAY = 100


class FaintspotControl(BaseProcessingObj):  # type: ignore[misc]
    """Commands from slopes; replaces SPECULA's `Modalrec` and `Integrator`.

    Parameters
    ----------
    controller : str or callable
        File of a `faintspot.control.PredictiveControl` (`save`), or a function from slopes to commands.
    nmodes : int
        Number of commands, which are zero until the first frame.
    delay : int
        Frames by which commands are sent later, as of `Integrator`.
    target_device_idx, precision
        As for `Integrator`; commands are computed on the CPU.

    Raises
    ------
    InputError
        When the file cannot be read.
    """

    def __init__(
        self,
        controller: str | Callable[[NDArray[np.float64]], NDArray[np.float64]],
        nmodes: int,
        delay: int = 0,
        target_device_idx: int | None = None,
        precision: int | None = None,
    ) -> None:
        check_version("SPECULA", "specula", TESTED)
        super().__init__(target_device_idx=target_device_idx, precision=precision)
        self.controller = PredictiveControl.load(controller) if isinstance(controller, str) else controller
        frames = int(number_between("delay", delay, 0, _MOST_DELAY, integer=True))
        self._waiting = deque(np.zeros((frames, nmodes)))
        commands = self.xp.zeros(nmodes, dtype=self.dtype)
        self.out_comm = BaseValue(value=commands, target_device_idx=target_device_idx, precision=precision)
        self.inputs["in_slopes"] = InputValue(type=Slopes)
        self.outputs["out_comm"] = self.out_comm

    @classmethod
    def input_names(cls) -> dict[str, object]:
        """Return the input."""
        return {"in_slopes": InputDesc(Slopes, "Residual slopes")}

    @classmethod
    def output_names(cls) -> dict[str, object]:
        """Return the output."""
        return {"out_comm": OutputDesc(BaseValue, "Commands, with the delay")}

    def trigger_code(self) -> None:
        """Compute the command of a frame, and send the one that is due."""
        slopes = np.asarray(cpuArray(self.local_inputs["in_slopes"].slopes), np.float64)
        self._waiting.append(np.array(self.controller(slopes)))
        self.out_comm.value[:] = self.to_xp(self._waiting.popleft(), dtype=self.dtype)
        self.out_comm.generation_time = self.current_time
