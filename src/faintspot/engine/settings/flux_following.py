"""Running mean of the flux of every sub-aperture over an engine's frames, for estimators that use it."""

from __future__ import annotations

import threading
from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.engine.settings.plan import EnginePlan
from faintspot.engine.settings.running_settings import RunningSettings
from faintspot.slopes.kernels.compilation.compiling import Direct, compiled_with
from faintspot.slopes.pipeline.mean_flux import MeanFlux

TIME_CONSTANT_FRAMES = 1000.0
_FEWEST_FRAMES = 100  # before the first change
_BETWEEN_S = 0.1


@partial(compiled_with, source=__file__)
def add_flux(flux: NDArray[np.float32], mean: NDArray[np.float64], frames: float) -> None:
    """Add one frame's flux (n,) to a running mean over `frames` frames; ignore values that are not finite."""
    for s in range(flux.shape[0]):
        if np.isfinite(flux[s]):
            mean[s] += (flux[s] - mean[s]) / frames


class FluxFollower:
    """Follower of the mean flux, measured as `MeanFlux` does, that sets `flux_e` when it has changed.

    A separate thread prepares the new settings, as for any change. Nothing changes if the running estimator
    does not use the flux.

    Parameters
    ----------
    live : LiveSettings
    time_constant_frames : float

    Raises
    ------
    InputError
        When the time constant is below 1.
    """

    def __init__(
        self, live: RunningSettings[EnginePlan], time_constant_frames: float = TIME_CONSTANT_FRAMES
    ) -> None:
        self._live = live
        self._longest = number_between("mean_flux", time_constant_frames, 1)
        self._mean = np.zeros(len(live.running.layout))
        self._frames = 0.0
        self._add = Direct(add_flux)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="faintspot-flux", daemon=True)
        self.take(np.zeros(len(self._mean), np.float32))  # compile now
        self._frames = 0.0

    def start(self) -> None:
        """Start following the flux."""
        self._thread.start()

    def close(self) -> None:
        """Stop following the flux."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def take(self, flux_e: NDArray[np.float32]) -> None:
        """Add one frame's flux; for the engine's thread."""
        self._frames = min(self._frames + 1.0, self._longest)
        self._add(flux_e, self._mean, self._frames)

    def step(self) -> bool:
        """Set the flux if it has changed by more than the settings distinguish; return whether it has."""
        if self._frames < min(_FEWEST_FRAMES, self._longest):
            return False
        pipeline = self._live.running.pipelines[0]
        if not pipeline.settings.estimator.uses_flux:
            return False
        illuminated = pipeline.with_flux(MeanFlux(self._mean.copy(), self._longest))
        if illuminated is pipeline:
            return False
        self._live.wait(self._live.propose({"flux_e": illuminated.settings.flux_e}))
        return True

    def _follow(self) -> None:
        while not self._stopping.wait(_BETWEEN_S):
            try:
                self.step()
            except InputError:  # another change came at the same time: try again
                continue
