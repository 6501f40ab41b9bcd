"""Running means over an engine's frames: windows without any flux, and the flux of every sub-aperture."""

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
from faintspot.slopes.kernels.driver.dark import BRIGHT, add_windows
from faintspot.slopes.pipeline.light import MeanFlux, MeanLight
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout

EVERY = 32
"""Frames of which one is added to the mean of a window."""
_SHORT, _LONG = 8, 256  # frames in the mean of each window: of bright stars, of others
_BRIGHT_PART = 0.9  # of the windows, below the significance of which a star is not bright


class DarkFollower:
    """Follower of the sub-apertures that have no flux in the mean of many frames.

    Each frame adds a part of the windows to their means, so that no frame takes longer than others. With
    bright stars, a window is dark when it has no flux for a few hundred frames; with faint ones, or none at
    all, when 256 frames of it, spread over 8192, show none. It is lit again as soon as flux shows.

    Parameters
    ----------
    pipeline : SlopePipeline
        Of the engine; only layout, calibration and the width of the spots count.
    """

    def __init__(self, pipeline: SlopePipeline) -> None:
        layout, test = pipeline.layout, pipeline.light_test
        self._n, self._test = len(layout), test
        ny, nx = layout.window
        stacked = Layout.stacked(self._n, layout.window)
        maps = layout.images(test.maps).reshape(2, self._n * ny, nx)
        self._light = MeanLight(stacked, maps, pipeline.plan.typical_fwhm_px)
        self._mean = np.zeros((self._n * ny, nx), np.float32)
        self._part, self._frames, self._most = 0, 0, _LONG
        self._add = {dtype: Direct(add_windows) for dtype in map(np.dtype, (np.uint16, np.float32))}
        for dtype in self._add:  # compile now
            self._add[dtype](test, np.zeros((1, *layout.frame_shape), dtype), 0, 0, 1.0, self._mean)
        self.dark = np.zeros(self._n, np.bool_)
        """Mask of the dark sub-apertures, (n,)."""
        self.changes = 0
        """Number of changes of `dark`."""

    def take(self, frames: NDArray[np.generic]) -> None:
        """Add a part of a frame (1, h, w) to the means; for the engine's thread."""
        if not self._test.box:
            return
        start, stop = (part * self._n // EVERY for part in (self._part, self._part + 1))
        weight = 1.0 / min(self._frames + 1, self._most)
        self._add[frames.dtype](self._test, frames, start, stop, weight, self._mean)
        self._part += 1
        if self._part == EVERY:
            self._part, self._frames = 0, min(self._frames + 1, self._most)

    def look(self) -> bool:
        """Find the dark sub-apertures anew; return whether any have changed. For one thread at a time."""
        frames = self._frames
        if frames < _SHORT or not self._test.box:
            return False
        found = self._light.significances(self._mean)
        bright = float(np.quantile(found, _BRIGHT_PART)) * float(self._test.limit) >= BRIGHT
        self._most = _SHORT if bright else _LONG
        dark = self.dark & (found < 1.0)
        if bright or frames >= _LONG:
            dark = found < 1.0
        if np.array_equal(dark, self.dark):
            return False
        self.dark, self.changes = dark, self.changes + 1
        return True


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
