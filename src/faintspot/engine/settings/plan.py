"""Settings prepared for their first frame, and running means over frames: dark windows and flux."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.engine.frames.frame_path import FramePath, Progress, check_real_time
from faintspot.engine.frames.pixel_ring import ARRIVALS, ROWS, PixelRing
from faintspot.engine.frames.python_path import PythonPath, call_within, tried
from faintspot.engine.frames.workers import SlopePrior, Workers
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.engine.settings.running_settings import RunningSettings
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.kernels.compiling import Direct, compiled_with
from faintspot.slopes.kernels.gather import Frames
from faintspot.slopes.kernels.validity.dark import BRIGHT, add_windows
from faintspot.slopes.pipeline.light import MeanFlux, MeanLight
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout


@dataclass(frozen=True)
class EngineOptions:
    """Options of an engine.

    Parameters
    ----------
    threads : int
        Number of threads that measure.
    cpus : sequence of int, optional
        Processors to pin threads to; the first one is for the thread that calls `Engine.run`.
    deadline_s : float
        Latency from a frame's last row beyond which slopes count as late.
    images_every : int
        Interval, in frames of one configuration, at which telemetry keeps images; 0: no images.
    mean_flux : float, optional
        Number of frames over which the flux of each sub-aperture is averaged, for estimators that use it.
        Default: they keep `flux_e`.
    polls : bool
        Whether threads poll for rows all the time. Default: they sleep until shortly before rows are due.
    """

    threads: int = 1
    cpus: Sequence[int] | None = None
    deadline_s: float = 1e-3
    images_every: int = 100
    mean_flux: float | None = None
    polls: bool = False


TRIAL_LIMIT_S = 60.0  # long enough for an estimator that compiles


class EnginePlan:
    """Settings and all that is prepared from them: a pipeline and a frame path for every configuration.

    Parameters
    ----------
    pipelines : sequence of SlopePipeline
        One for each configuration that takes turns.
    settings : Settings
        Settings that the configurations' changes are added to.
    interleaving : Interleaving
        The configurations that take turns.
    new_path : function
        Makes the frame path of a pipeline, compiled and warmed up, from the memory and progress of frames.
    fallback : EnginePlan, optional
        Replacement when a user-defined estimator fails.
    """

    def __init__(
        self,
        pipelines: Sequence[SlopePipeline],
        settings: Settings,
        interleaving: Interleaving,
        new_path: Callable[[SlopePipeline, NDArray[Any], Progress], FramePath],
        fallback: EnginePlan | None = None,
    ) -> None:
        self.settings, self.layout, self.interleaving = settings, pipelines[0].layout, interleaving
        self.pipelines, self.fallback, self._new_path = tuple(pipelines), fallback, new_path
        self._ring: PixelRing | None = None
        self._paths: tuple[FramePath, ...] = ()

    @property
    def estimator_names(self) -> set[str]:
        """Names of the estimators of all configurations."""
        return {pipeline.settings.estimator.name for pipeline in self.pipelines}

    def paths(self, ring: PixelRing) -> tuple[FramePath, ...]:
        """Return the paths of a ring's frames, one for each configuration, compiled and warmed up."""
        if ring is not self._ring:
            if self.fallback is not None:
                self.fallback.paths(ring)
            cells, pixels = writable_view(ring.cells), writable_view(ring.pixels)
            columns = ring.cells.shape[1]
            # Frames are identified by their arrival, which counts up even if frame numbers repeat.
            progress = Progress(cells, ARRIVALS * columns, ROWS * columns)
            self._paths = tuple(self._new_path(pipeline, pixels, progress) for pipeline in self.pipelines)
            self._ring = ring
        return self._paths

    def warm_up(self) -> None:
        """Compile all that measures frames while their type is not yet known."""
        if self.fallback is not None:
            self.fallback.warm_up()
        progress = Progress(np.zeros((2, 1), np.int64), 0, 1)
        nothing = np.zeros((1, *self.layout.frame_shape), np.uint16)
        for pipeline in self.pipelines:
            self._new_path(pipeline, nothing, progress)


class SettingsPreparer:
    """Preparation of settings while the engine runs.

    Parameters
    ----------
    make_pipeline : function
        Function that makes a pipeline from settings.
    interleaving : Interleaving
    workers : Workers, optional
    budget_s : float
        Time limit for one frame of an estimator in NumPy.
    prior : SlopePrior, optional
        Predicted slopes; see `FramePath`.
    """

    def __init__(
        self,
        make_pipeline: Callable[[Settings], SlopePipeline],
        interleaving: Interleaving,
        workers: Workers | None,
        budget_s: float,
        prior: SlopePrior | None = None,
    ) -> None:
        self.make_pipeline = make_pipeline
        self.interleaving = interleaving
        """Interleaving of all settings that are prepared from now on."""
        self._workers, self._budget_s, self._prior = workers, budget_s, prior
        self.ring: PixelRing | None = None
        """Ring whose frames are being measured, if any."""
        self._built_in: Estimator = estimator_named("brightest")()

    def prepare(self, settings: Settings) -> EnginePlan:
        """Prepare settings for a ring's frames or, without a ring, for frames of any type.

        Raises
        ------
        InputError
            When the settings or those of a configuration do not fit, or an estimator fails its trial.
        """
        pipelines = [self._pipeline(method.of(settings)) for method in self.interleaving.methods]
        for pipeline in pipelines:
            check_real_time(pipeline)
        built_in = all(is_built_in(pipeline.settings.estimator) for pipeline in pipelines)
        fallback = None if built_in else self._fallback(settings)
        prepared = EnginePlan(pipelines, settings, self.interleaving, self._new_path, fallback)
        if self.ring is None:
            prepared.warm_up()
        else:
            prepared.paths(self.ring)
        if is_built_in(settings.estimator):
            self._built_in = settings.estimator
        return prepared

    @contextmanager
    def kept_if_right(self) -> Iterator[None]:
        """Undo changes of `make_pipeline` and `interleaving` that are made inside if an error leaves it."""
        before = self.make_pipeline, self.interleaving
        try:
            yield
        except BaseException:
            self.make_pipeline, self.interleaving = before
            raise

    def built_in(self, settings: Settings) -> Settings:
        """Return settings in which the last built-in estimator replaces a user-defined one."""
        if is_built_in(settings.estimator):
            return settings
        return settings.replace(estimator=self._built_in)

    def _fallback(self, settings: Settings) -> EnginePlan:
        """Prepare the same settings with a built-in estimator and no interleaving."""
        settings, turns = self.built_in(settings), self.interleaving
        is_alone = len(turns.methods) == 1 and not turns.methods[0].changes
        alone = turns if is_alone else Interleaving(first=turns.first + len(turns.methods))
        return EnginePlan([self.make_pipeline(settings)], settings, alone, self._new_path)

    def _new_path(self, pipeline: SlopePipeline, pixels: NDArray[Any], progress: Progress) -> FramePath:
        made_for = pipeline, pixels, progress
        path = (
            PythonPath(*made_for, workers=self._workers, prior=self._prior, budget_s=self._budget_s)
            if pipeline.plan.prepared.in_python
            else FramePath(*made_for, workers=self._workers, prior=self._prior)
        )
        path.warm_up()
        return path

    def _pipeline(self, settings: Settings) -> SlopePipeline:
        if is_built_in(settings.estimator):
            return self.make_pipeline(settings)
        title = f"estimator {settings.estimator.name!r}"
        return call_within(TRIAL_LIMIT_S, title, tried, self.make_pipeline, settings, self._budget_s)


def is_built_in(estimator: Estimator) -> bool:
    """Return whether an estimator is part of this package."""
    return type(estimator).__module__.startswith(f"{__package__.partition('.')[0]}.")


class _WritableMemory:
    """Memory of an array, declared writable; one class for all, because classes need garbage collection."""

    def __init__(self, array: NDArray[np.generic]) -> None:
        self._array = array
        interface = array.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], False)}


def writable_view(array: NDArray[np.generic]) -> NDArray[Any]:
    """Return a writable array of the same memory, of the type that kernels are compiled for.

    The kernels do not write to it; this avoids compiling each of them again for read-only memory.
    """
    return np.asarray(_WritableMemory(array))


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
        self._add = Direct(add_windows)
        nothing = Frames.of(np.zeros((1, *layout.frame_shape), np.uint16))
        self._add(test, nothing, 0, 0, 1.0, self._mean)  # compile now
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
        self._add(self._test, Frames.of(frames), start, stop, weight, self._mean)
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
    live : RunningSettings
    time_constant_frames : float

    Raises
    ------
    InputError
        When the time constant is below 1.
    """

    def __init__(self, live: RunningSettings[EnginePlan], time_constant_frames: float) -> None:
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
