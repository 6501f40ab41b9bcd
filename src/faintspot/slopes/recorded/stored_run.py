"""Slopes in a file, and what could be rebuilt of the run that made them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from numpy.typing import ArrayLike

from faintspot.base.errors import DoubtWarning, InputError
from faintspot.base.flags import SubapertureFlag, kept_flags
from faintspot.base.text_files import parse_text
from faintspot.io import StoredSlopes, read_slopes
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.window_checks import removed_terms
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

if TYPE_CHECKING:
    from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
    from faintspot.slopes.spots.laser_spots import LaserSpots


@dataclass
class StoredRun:
    """One file of slopes and what could be rebuilt from its attributes; `notes` says what could not."""

    path: Path
    stored: StoredSlopes
    notes: list[str]
    layout: Layout | None = None
    settings: Settings | None = None
    calibration: Calibration | None = None
    spot: dict[str, Any] = field(default_factory=dict)
    """PSF and weights, as for `SlopePipeline`; None where there are none."""
    laser: LaserSpots | None = None
    flux_unit: str = "e-"
    """Unit of the flux: "ADU" where the configuration states no gain of the camera."""
    lost: list[str] = field(default_factory=list)
    """Optional parts of a pipeline: a PSF or weights, whose file may be missing."""

    @property
    def about_reference(self) -> str:
        """Note about the terms that its slopes lack, as their reference was fitted to a frame."""
        if self.layout is None or not self.layout.fitted or "reference" in self.stored.attributes:
            return ""
        terms = removed_terms(self.layout.fitted)
        return f"The {terms} of the layout's frame are in the reference, not in these slopes."

    @property
    def estimator(self) -> Estimator | None:
        """The estimator of the run, when its settings are known."""
        return None if self.settings is None else self.settings.estimator

    @property
    def sources(self) -> list[str]:
        """The files that the frames came from."""
        sources = self.stored.attributes.get("sources", [])
        return [sources] if isinstance(sources, str) else [str(item) for item in sources]

    @property
    def keep(self) -> SubapertureFlag:
        """Flags that do not make its slopes invalid."""
        return kept_flags(self.stored.attributes.get("keep", ()))

    @property
    def followed(self) -> bool:
        """Whether its spots were followed out of their windows."""
        return bool(self.stored.attributes.get("followed", False))

    @property
    def text(self) -> str:
        """The configuration."""
        return str(self.stored.attributes.get("configuration", ""))

    def pipeline(
        self, estimator: Estimator | None = None, reference: ArrayLike | None = None
    ) -> SlopePipeline:
        """Return the pipeline of the run, or the same with another estimator.

        Raises
        ------
        InputError
            When the layout, the settings or something that the estimator needs are not known.
        """
        from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline  # telemetry needs the layout only

        settings = self.settings
        if self.layout is None or settings is None or self.calibration is None:
            raise InputError(f"layout, settings or calibration of {self.path.name} are not known")
        if estimator is not None:
            settings = settings.replace(estimator=estimator)
        try:
            return SlopePipeline(self.layout, settings, self.calibration, reference, **self.spot)
        except InputError as error:
            raise InputError("; ".join(self.lost) or str(error)) from None


def open_run(path: Path, *, layout_only: bool = False) -> StoredRun:
    """Read one file of slopes and rebuild what its attributes describe."""
    stored = read_slopes(path)
    if stored.n_finished == 0:
        raise InputError(f"{path}: expected slopes, no frame is finished yet")
    store = StoredRun(path, stored, [])
    if not stored.complete:
        store.notes.append(f"{path.name} is unfinished: {stored.n_finished} frames are there so far.")
    if not store.text:
        store.notes.append(f"{path.name} does not say with which configuration it was made.")
        return store
    try:
        _rebuild(store, layout_only)
    except InputError as error:
        store.notes.append(f"The configuration stored in {path.name} cannot be used: {error}.")
    if store.layout is not None and store.layout.doubts:
        doubts = "; ".join(store.layout.doubts)
        store.notes.append(f"The layout of {path.name} was doubtful: {doubts}.")
    if store.about_reference:
        store.notes.append(store.about_reference)
    n = stored.variables["x"].shape[1]
    if store.layout is not None and len(store.layout) != n:
        store.notes.append(
            f"The layout stored in {path.name} has {len(store.layout)} sub-apertures, the slopes have {n}: "
            "not used."
        )
        store.layout = None
    return store


def _rebuild(store: StoredRun, layout_only: bool) -> None:
    """Make layout, settings and calibration from the stored text, and maps from the original file."""
    stored = configuration.Configuration("", parse_text(store.text, "configuration"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)  # said as a note
        store.layout = stored.layout
    if layout_only:
        return
    store.settings = stored.settings
    table = stored.tables.get("calibration", {})
    store.flux_unit = "e-" if "gain_e_per_adu" in table else "ADU"
    if any(map(_is_map, table.values())):
        store.calibration = _original_calibration(store, table)
    else:
        store.calibration = stored.calibration
    loaders = {"psf": PSF.load, "weights": FixedWeights.load}
    store.spot = {part: _of_the_spot(store, part, load) for part, load in loaders.items()}
    store.laser = _of_the_spot(store, "laser", lambda path: configuration.Configuration(path).laser)


def _of_the_spot(store: StoredRun, name: str, load: Callable[[str], object]) -> Any:
    """Read the PSF or the weights of the run; a missing file is reported when it is needed."""
    attributes = store.stored.attributes
    file, original = (str(attributes.get(key, "")) for key in (f"{name}_file", "configuration_file"))
    try:
        if file and file != original:
            return load(file)
        if file or Path(original).is_file():
            return getattr(configuration.Configuration(original), name)
    except InputError as error:
        words = {"psf": "PSF", "weights": "fixed weights", "laser": "laser guide star"}[name]
        store.lost.append(f"the {words} of {store.path.name} is gone ({error})")
    return None


def _is_map(value: object) -> bool:
    """Whether the stored text has a description in place of a map."""
    return isinstance(value, str) and value.startswith("map of")


def _original_calibration(store: StoredRun, stored_table: Mapping[str, object]) -> Calibration | None:
    """Read a calibration with maps from the configuration file of the run, if it is still the same."""
    original = store.stored.attributes.get("configuration_file")
    if not original or not Path(str(original)).exists():
        store.notes.append(
            f"The calibration maps of {store.path.name} are not found (configuration file "
            f"{original or 'unknown'})."
        )
        return None
    try:
        calibration = Calibration.load(str(original))
    except InputError as error:
        store.notes.append(f"The calibration maps of {store.path.name} cannot be read: {error}.")
        return None
    now = tomlkit.parse(configuration.to_text(calibration)).unwrap()["calibration"]
    if now != stored_table:
        store.notes.append(f"The calibration in {original} has changed since {store.path.name} was made.")
    return calibration
