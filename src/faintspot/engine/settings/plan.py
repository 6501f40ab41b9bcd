"""Settings prepared for their first frame: pipelines, and frame paths through them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.engine.path.frame_path import FramePath, Progress, check_real_time
from faintspot.engine.path.python_path import PythonPath, call_within, tried
from faintspot.engine.path.workers import SlopePrior, Workers
from faintspot.engine.pixels.pixel_ring import ARRIVALS, ROWS, PixelRing
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline


class FrameInput(Protocol):
    """Source that brings frames into the ring in the engine's own thread."""

    def step(self) -> bool:
        """Wait a moment for a frame; return whether one has come."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...


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
        for dtype in (np.uint16, np.float32):
            for pipeline in self.pipelines:
                self._new_path(pipeline, np.zeros((1, *self.layout.frame_shape), dtype), progress)


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
    prior : Prior, optional
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
        alone = turns if len(turns.methods) == 1 else Interleaving(first=turns.first + len(turns.methods))
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
