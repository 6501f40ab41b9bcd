"""The report page of slopes that lie in files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray
from tomlkit.exceptions import TOMLKitError

from faintspot import configuration
from faintspot.errors import InputError
from faintspot.io import StoredSlopes, open_frames, read_slopes
from faintspot.pipeline import SlopePipeline
from faintspot.recorded.advice import settings_in_words
from faintspot.recorded.page import slopes_report
from faintspot.recorded.statistics import MeasuredSlopes
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.settings import Settings
from faintspot.slopes import Stages

_SAME_PLACE_PX = 1e-4  # the text of a configuration is rounded
_SAME_POSITION_PX = 0.02
"""Recomputed positions differ by less, whatever processor computed the stored ones."""


@dataclass
class _Store:
    """One file of slopes and what could be rebuilt from its attributes; `notes` says what could not."""

    path: Path
    stored: StoredSlopes
    notes: list[str]
    layout: Layout | None = None
    settings: Settings | None = None
    calibration: Calibration | None = None

    @property
    def sources(self) -> list[str]:
        """The files that the frames came from."""
        found = self.stored.attributes.get("sources", [])
        return [found] if isinstance(found, str) else [str(item) for item in found]

    @property
    def text(self) -> str:
        """The configuration."""
        return str(self.stored.attributes.get("configuration", ""))


def report_of_stored(paths: Sequence[str | Path], *, frames: Sequence[str | Path] | None = None) -> str:
    """Return the report page (HTML) of one file of slopes, or of two of the same frames.

    Layout, settings and calibration are rebuilt from what the file says about its run. The frame with the
    median total flux is taken from the run's sources and measured again for the pictures. What is missing is
    said on the page.

    Parameters
    ----------
    paths : one or two paths
        Slopes as `faintspot.io.create_writer` wrote them; two to compare, as denoised and not.
    frames : paths, optional
        Where the frames are now. Default: where they were.

    Raises
    ------
    InputError
        When a file cannot be read, has no finished frame, or two do not have the same sub-apertures.
    MissingExtraError
        When matplotlib, jinja2 or the package that reads a file is not installed.
    """
    if not 1 <= len(paths) <= 2:
        raise InputError(f"slopes: expected one file or two to compare, got {len(paths)}")
    stores = [_open(Path(path)) for path in paths]
    first = stores[0]
    for other in stores[1:]:
        _check_same_sensor(first, other)
    arms, notes = _arms(stores)
    total = np.where(arms[0].valid, arms[0].flux, 0.0).sum(axis=1)
    example_frame = int(np.argsort(total, kind="stable")[(len(total) - 1) // 2])
    stages, reason = _example(stores, arms, example_frame, frames, notes)
    if "calibration" in reason:
        notes.append(reason)
    return slopes_report(
        arms,
        layout=first.layout,
        stages=stages,
        title=f"Slopes of {' and '.join(store.path.name for store in stores)}",
        facts=_facts(stores, arms),
        configuration="\n\n".join(dict.fromkeys(store.text for store in stores)),
        example_frame=example_frame,
        warnings=list(dict.fromkeys([note for store in stores for note in store.notes] + notes)),
        why_no_stages=reason,
    )


def _open(path: Path) -> _Store:
    """Read one file of slopes and rebuild what its attributes describe."""
    stored = read_slopes(path)
    if stored.n_finished == 0:
        raise InputError(f"{path}: expected slopes, no frame is finished yet")
    store = _Store(path, stored, [])
    if not stored.complete:
        store.notes.append(f"{path.name} is unfinished: {stored.n_finished} frames are there so far.")
    if not store.text:
        store.notes.append(f"{path.name} does not say with which configuration it was made.")
        return store
    try:
        _rebuild(store)
    except InputError as error:
        store.notes.append(f"The configuration stored in {path.name} cannot be used: {error}.")
    n = stored.variables["x"].shape[1]
    if store.layout is not None and len(store.layout) != n:
        store.notes.append(
            f"The layout stored in {path.name} has {len(store.layout)} sub-apertures, the slopes have {n}: "
            "not used."
        )
        store.layout = None
    return store


def _rebuild(store: _Store) -> None:
    """Make layout, settings and calibration from the stored text, and maps from the original file."""
    try:
        tables: dict[str, Any] = tomlkit.parse(store.text).unwrap()
    except TOMLKitError as error:
        raise InputError(f"not TOML: {str(error).splitlines()[0]}") from None
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "configuration"
        copy.write_text(tomlkit.dumps(tables), encoding="utf-8")
        try:
            store.layout = configuration.load(copy, "layout")
            store.settings = configuration.load(copy, "settings")
            mapless = not any(_is_map(value) for value in tables.get("calibration", {}).values())
            if mapless:
                store.calibration = configuration.load(copy, "calibration")
        except InputError as error:
            raise InputError(str(error).replace(f"{copy}: ", "")) from None
    if not mapless:
        store.calibration = _original_calibration(store, tables["calibration"])


def _is_map(value: Any) -> bool:
    """Whether the stored text has a description in place of a map."""
    return isinstance(value, str) and value.startswith("map of")


def _original_calibration(store: _Store, stored_table: dict[str, Any]) -> Calibration | None:
    """Read a calibration with maps from the configuration file of the run, if it is still the same."""
    original = store.stored.attributes.get("configuration_file")
    if not original or not Path(str(original)).exists():
        store.notes.append(
            f"The calibration maps of {store.path.name} are not found (configuration file "
            f"{original or 'unknown'})."
        )
        return None
    try:
        calibration: Calibration = configuration.load(str(original), "calibration")
    except InputError as error:
        store.notes.append(f"The calibration maps of {store.path.name} cannot be read: {error}.")
        return None
    now = tomlkit.parse(configuration.to_text(calibration)).unwrap()["calibration"]
    if now != stored_table:
        store.notes.append(f"The calibration in {original} has changed since {store.path.name} was made.")
    return calibration


def _check_same_sensor(first: _Store, other: _Store) -> None:
    mine, theirs = (store.stored.variables["x"].shape[1] for store in (first, other))
    if mine != theirs:
        raise InputError(f"{other.path}: expected {mine} sub-apertures, as in {first.path}, got {theirs}")
    if first.layout is None or other.layout is None:
        return
    same = all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, atol=_SAME_PLACE_PX)
        for name in ("frame_shape", "window", "corners", "centres")
        for a, b in [(getattr(first.layout, name), getattr(other.layout, name))]
    )
    if not same:
        raise InputError(f"{other.path}: expected the layout of {first.path}, got another")


def _arms(stores: Sequence[_Store]) -> tuple[list[MeasuredSlopes], list[str]]:
    """Return the slopes of the frames that all files have, and notes about it."""
    notes = []
    counts = [store.stored.n_finished for store in stores]
    if len(set(counts)) > 1:
        notes.append(
            f"The files hold {counts[0]} and {counts[1]} frames: the first {min(counts)} are compared."
        )
    if len(stores) == 2 and stores[0].sources != stores[1].sources:
        notes.append(
            "The two files were made from different sources: differences are not due to settings alone."
        )
    arms = []
    for name, store in zip(_names(stores), stores, strict=True):
        variables = store.stored.variables
        arrays = [variables[field.name][: min(counts)] for field in fields(MeasuredSlopes)[1:]]
        arms.append(MeasuredSlopes(name, *arrays))
    return arms, notes


def _names(stores: Sequence[_Store]) -> list[str]:
    """Name the arms by what they do where that tells them apart, else by their files."""
    names = [_arm_name(store) for store in stores]
    if len(set(names)) == len(names):
        return names
    files = [store.path.name for store in stores]
    if len(set(files)) < len(files):
        files = [str(store.path) for store in stores]
    if len(set(files)) < len(files):
        raise InputError(f"{stores[0].path}: expected two different files of slopes, got the same twice")
    return files


def _arm_name(store: _Store) -> str:
    if store.settings is None:
        return store.path.name
    denoise = store.settings.denoise
    return "no TV" if not np.any(denoise) else "TV"


def _example(
    stores: Sequence[_Store],
    arms: Sequence[MeasuredSlopes],
    number: int,
    frames: Sequence[str | Path] | None,
    notes: list[str],
) -> tuple[dict[str, Stages] | None, str]:
    """Measure the example frame again in every arm; or return why that cannot be done."""
    if stores[0].layout is None:
        return None, "Not drawn: the layout is not known."
    try:
        frame = _frame(stores[0], number, frames)
        stages: dict[str, Stages] = {}
        for store, arm in zip(stores, arms, strict=True):
            if store.settings is None or store.calibration is None:
                return None, f"Not drawn: settings or calibration of {store.path.name} are not known."
            stages[arm.name] = SlopePipeline(stores[0].layout, store.settings, store.calibration).explain(
                frame
            )
            notes += _disagreement(store, arm, frame, number)
        if len(stores) == 1 and arms[0].is_denoised:
            stages["no TV"] = _without_denoising(stores[0], frame)
    except InputError as error:
        return None, f"Not drawn: {error}."
    return stages, ""


def _frame(store: _Store, number: int, frames: Sequence[str | Path] | None) -> NDArray[Any]:
    places = list(frames) if frames is not None else store.sources
    if not places:
        raise InputError(f"{store.path.name} does not say where its frames came from")
    with open_frames(places, key=store.stored.attributes.get("source_key") or None) as source:
        frame: NDArray[Any] = source.block(number, number + 1)[0]
    return frame


def _without_denoising(store: _Store, frame: NDArray[Any]) -> Stages:
    assert store.layout is not None
    assert store.settings is not None
    settings = store.settings.replace(denoise=False)
    return SlopePipeline(store.layout, settings, store.calibration).explain(frame)


def _disagreement(store: _Store, arm: MeasuredSlopes, frame: NDArray[Any], number: int) -> list[str]:
    """Say so when the example frame, measured again, gives other slopes than are stored."""
    assert store.layout is not None
    assert store.settings is not None
    reference = store.stored.attributes.get("reference")
    slopes = SlopePipeline(store.layout, store.settings, store.calibration, reference)(frame)
    both = slopes.valid & arm.valid[number]
    again = np.stack([slopes.x, slopes.y])[:, both]
    distance = np.abs(again - np.stack([arm.x[number], arm.y[number]])[:, both])
    if distance.size == 0 or distance.max() <= _SAME_POSITION_PX:
        return []
    return [
        f"Measured again for the pictures, frame {number} gives positions that differ from those stored in "
        f"{store.path.name} by up to {distance.max():.2f} px: the calibration or the frames are "
        "not those of the run. The crosses show the new measurement."
    ]


def _median_standard_error(store: _Store) -> float:
    """Median over the slopes whose standard error is known of its rms of x and y, px; NaN without any."""
    x, y = (store.stored.variables[f"standard_error_{axis}"].astype(np.float64) for axis in "xy")
    errors = np.sqrt((x**2 + y**2) / 2)
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if known.size else np.nan


def _facts(stores: Sequence[_Store], arms: Sequence[MeasuredSlopes]) -> dict[str, str]:
    sources = list(dict.fromkeys(source for store in stores for source in store.sources))
    shown = ", ".join(sources[:4]) + (f" and {len(sources) - 4} more" if len(sources) > 4 else "")
    versions = dict.fromkeys(
        str(store.stored.attributes.get("faintspot_version", "unknown")) for store in stores
    )
    facts = {"Slopes": ", ".join(str(store.path) for store in stores), "Sources": shown or "not stored"}
    for store, arm in zip(stores, arms, strict=True):
        known = store.settings is not None and store.layout is not None
        words = settings_in_words(store.settings, store.layout) if known else "not stored"  # type: ignore[arg-type]
        of = f" of {arm.name!r}" if len(arms) > 1 else ""
        facts[f"Settings{of}"] = words
        error_px = _median_standard_error(store)
        if np.isfinite(error_px):
            facts[f"Median standard error{of}"] = f"{error_px:.3g} px per axis"
    if any("reference" in store.stored.attributes for store in stores):
        facts["Reference"] = "slopes are relative to stored reference positions; crosses in pictures are not"
    return {**facts, "Measured with": f"faintspot {', '.join(versions)}"}
