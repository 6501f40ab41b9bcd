"""Settings made ready for their first frame: pipelines, modules, and the paths of frames through them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators.python import PythonPrepared
from faintspot.pipeline import SlopePipeline
from faintspot.realtime.frame_path import FramePath, Progress, check_real_time
from faintspot.realtime.interleaving import Interleaving
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.modular_path import ModularPath
from faintspot.realtime.module_loading import Module
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.pixel_segment import ARRIVALS, ROWS
from faintspot.realtime.prior import Prior
from faintspot.realtime.workers import Workers
from faintspot.sensor.layout import Layout
from faintspot.settings import Settings
from faintspot.slopes import Slopes


class MeasuringPath(Protocol):
    """What measures frames: a `FramePath`, or one with modules in it."""

    slopes: Slopes
    fault: str | None

    def warm_up(self) -> None:
        """Have everything compiled."""
        ...

    @property
    def denoised(self) -> NDArray[np.float32]:
        """Images of the frame that was measured last, where they were asked for."""
        ...

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        ...

    @property
    def prior_std_px(self) -> NDArray[np.float64] | None:
        """How wide the prior is that slopes are drawn to, (2 n,); None: they are not."""
        ...

    def await_start(self, number: int) -> None:
        """Wait for the first row of a frame."""
        ...

    def measure(self, number: int, slot: int | None = None, *, explain: bool = False) -> bool:
        """Measure a frame; see `FramePath.measure`."""
        ...

    def stop(self) -> None:
        """End waiting for rows."""
        ...

    def go_on(self) -> None:
        """Wait for rows again."""
        ...


class PreparedSettings:
    """Settings with all that is made from them: for every arm a pipeline, and a path for a ring's frames.

    Parameters
    ----------
    pipelines : sequence of SlopePipeline
        One for every arm.
    settings : Settings
        Those that the arms' own changes are added to.
    interleaving : Interleaving
        Whose arms they are.
    modules : mapping of str to Module
        In place of built-in stages, by stage.
    workers : Workers, optional
    budget_s : float
        For modules, from a frame's last row.
    prior : Prior, optional
        Of all frames, see `FramePath`; what modules measure has none.

    Raises
    ------
    InputError
        When a module is refused.
    """

    def __init__(
        self,
        pipelines: Sequence[SlopePipeline],
        settings: Settings,
        interleaving: Interleaving,
        modules: Mapping[str, Module],
        workers: Workers | None,
        budget_s: float,
        prior: Prior | None = None,
    ) -> None:
        self.settings, self.layout, self.interleaving = settings, pipelines[0].layout, interleaving
        self.pipelines, self._workers, self._budget_s = tuple(pipelines), workers, budget_s
        self._prior = prior
        own = [stages_of(pipeline, modules) for pipeline in self.pipelines]
        self._modular = [
            ModularPipeline(pipeline, stages, budget_s=budget_s) if stages else None
            for pipeline, stages in zip(self.pipelines, own, strict=True)
        ]
        self._ring: PixelRing | None = None
        self._paths: tuple[MeasuringPath, ...] = ()

    def paths(self, ring: PixelRing) -> tuple[MeasuringPath, ...]:
        """Return the paths of a ring's frames, one for every arm, complete and warm."""
        if ring is not self._ring:
            made = zip(self.pipelines, self._modular, strict=True)
            self._paths = tuple(self._new_path(pipeline, modular, ring) for pipeline, modular in made)
            self._ring = ring
        return self._paths

    def _new_path(
        self, pipeline: SlopePipeline, modular: ModularPipeline | None, ring: PixelRing
    ) -> MeasuringPath:
        cells, pixels = writable_view(ring.cells), writable_view(ring.pixels)
        columns = ring.cells.shape[1]
        # Frames are known by their arrival, which counts up whatever a camera does to its frame numbers.
        progress = Progress(cells, ARRIVALS * columns, ROWS * columns)
        built_in = FramePath(pipeline, pixels, progress, workers=self._workers, prior=self._prior)
        path: MeasuringPath = built_in
        if modular is not None:
            path = ModularPath(modular, pixels, progress, built_in, budget_s=self._budget_s)
        path.warm_up()
        return path


def stages_of(pipeline: SlopePipeline, modules: Mapping[str, Module]) -> Mapping[str, Module]:
    """Return the modules, and what an estimator in NumPy does in the place of the compiled centroid."""
    prepared = pipeline.preparation.prepared
    if not isinstance(prepared, PythonPrepared) or "centroid" in modules:
        return modules

    def make(layout: Layout, settings: Settings) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        return prepared.positions

    name = prepared.estimator.name
    return {**modules, "centroid": Module(name, "centroid", make, type(prepared.estimator).__module__, "")}


class SettingsPreparer:
    """Prepares settings beside the running system.

    Parameters
    ----------
    make_pipeline : function
        Makes a pipeline from settings.
    interleaving : Interleaving
    workers : Workers, optional
    budget_s : float
        For modules, from a frame's last row.
    prior : Prior, optional
        Predicted slopes, see `FramePath`.
    """

    def __init__(
        self,
        make_pipeline: Callable[[Settings], SlopePipeline],
        interleaving: Interleaving,
        workers: Workers | None,
        budget_s: float,
        prior: Prior | None = None,
    ) -> None:
        self.make_pipeline = make_pipeline
        self.interleaving = interleaving
        """In all that is prepared from now on."""
        self._workers, self._budget_s, self._prior = workers, budget_s, prior
        self.ring: PixelRing | None = None
        """Whose frames are being measured, if any."""
        self.modules: Mapping[str, Module] = {}
        """In place of built-in stages in all that is prepared from now on, by stage."""

    def prepare(self, settings: Settings) -> PreparedSettings:
        """Prepare settings; where there is a ring, for its frames.

        Raises
        ------
        InputError
            When the settings do not fit, or what an arm makes of them, or a module is refused.
        """
        pipelines = [self.make_pipeline(each) for each in self.of_arms(settings)]
        for pipeline in pipelines:
            check_real_time(pipeline)
        made_for = self._workers, self._budget_s, self._prior
        prepared = PreparedSettings(pipelines, settings, self.interleaving, self.modules, *made_for)
        ring = self.ring
        if ring is not None:
            prepared.paths(ring)
        return prepared

    def of_arms(self, settings: Settings) -> list[Settings]:
        """Return the settings of every arm."""
        return [arm.of(settings) for arm in self.interleaving.arms]


class _WritableMemory:
    """An array's memory, said to be writable. Not a class for each array: classes need the collector."""

    def __init__(self, array: NDArray[Any]) -> None:
        self._array = array
        interface = array.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], False)}


def writable_view(array: NDArray[Any]) -> NDArray[Any]:
    """Return the same memory as an array of the kind that kernels are compiled for, which may be written to.

    Nobody writes: it spares compiling every kernel once more for memory that is read-only.
    """
    return np.asarray(_WritableMemory(array))
