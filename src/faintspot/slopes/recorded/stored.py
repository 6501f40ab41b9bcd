"""The report page of slopes that lie in files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.base.report.page import Report
from faintspot.base.report.texts import Texts
from faintspot.io import open_frames
from faintspot.io.slopes import subtracted_reference
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.page import NO_LAYOUT, SlopesRun, slopes_report
from faintspot.slopes.recorded.pictures import Example, Followed, farthest_frame
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.recorded.stored_run import StoredRun, open_run
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.slopes.recorded")


_SAME_PLACE_PX = 1e-4  # the text of a configuration is rounded
_SAME_POSITION_PX = 0.02
"""Recomputed positions differ by less, whatever processor computed the stored ones."""


def report_of_stored(paths: Sequence[str | Path], *, frames: Sequence[str | Path] | None = None) -> Report:
    """Return the report of one file of slopes, or of two of the same frames.

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
        When matplotlib or the package that reads a file is not installed.
    """
    if not 1 <= len(paths) <= 2:
        raise InputError(f"slopes: expected one file or two to compare, got {len(paths)}")
    stores = [open_run(Path(path)) for path in paths]
    first = stores[0]
    for store in stores[1:]:
        if store.path == first.path:
            raise InputError(f"{first.path}: expected two different files of slopes, got the same twice")
        _check_same_sensor(first, store)
    methods, notes = _methods(stores)
    return slopes_report(
        SlopesRun(methods, first.layout, _shown(stores, methods, frames, notes), unit=first.flux_unit),
        title=f"Slopes of {' and '.join(store.path.name for store in stores)}",
        facts=_facts(stores, methods),
        configurations=_configurations(stores, methods),
        warnings=list(dict.fromkeys(notes)),
    )


def _configurations(stores: Sequence[StoredRun], methods: Sequence[MeasuredSlopes]) -> dict[str, str]:
    """Return the configurations by what they are of: one where all are the same."""
    if len({store.text for store in stores}) == 1:
        return {"Configuration": stores[0].text}
    return {
        f"Configuration of {method.name}": store.text for store, method in zip(stores, methods, strict=True)
    }


def _check_same_sensor(first: StoredRun, second: StoredRun) -> None:
    n, other_n = (store.stored.variables["x"].shape[1] for store in (first, second))
    if n != other_n:
        raise InputError(f"{second.path}: expected {n} sub-apertures, as in {first.path}, got {other_n}")
    if first.layout is None or second.layout is None:
        return
    same = all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, atol=_SAME_PLACE_PX)
        for name in ("frame_shape", "window", "corners", "centres")
        for a, b in [(getattr(first.layout, name), getattr(second.layout, name))]
    )
    if not same:
        raise InputError(f"{second.path}: expected the layout of {first.path}, got another")


def _methods(stores: Sequence[StoredRun]) -> tuple[list[MeasuredSlopes], list[str]]:
    """Return the slopes of the frames that all files have, and notes about it."""
    names, notes = _names(stores), list[str]()
    for name, store in zip(names, stores, strict=True):
        label = f"{name}: " if len(names) > 1 else ""
        notes += [label + note for note in store.notes]
    counts = [store.stored.n_finished for store in stores]
    if len(set(counts)) > 1:
        lengths = {"first": counts[0], "second": counts[1], "fewest": min(counts)}
        notes.append(_TEXT("stored.other_lengths", **lengths))
    sources = [store.sources for store in stores if store.sources]
    if len(sources) == 2 and sources[0] != sources[1]:
        notes.append(_TEXT["stored.other_sources"])
    methods = []
    for name, store in zip(names, stores, strict=True):
        slopes = Slopes.from_variables(store.stored.variables, min(counts), store.keep)
        methods.append(MeasuredSlopes(name, slopes))
    return methods, notes


def _names(stores: Sequence[StoredRun]) -> list[str]:
    """Name the methods by what they do where that tells them apart, else by their files."""
    names = [store.path.name if store.estimator is None else store.estimator.label for store in stores]
    if len(set(names)) < len(names):
        names = [store.path.name for store in stores]
    return names if len(set(names)) == len(names) else [str(store.path) for store in stores]


def _shown(
    stores: Sequence[StoredRun],
    methods: Sequence[MeasuredSlopes],
    frames: Sequence[str | Path] | None,
    notes: list[str],
) -> Example | Followed | str:
    """Return the frame of the pictures, or why there is none; add notes."""
    if stores[0].layout is None:
        return NO_LAYOUT
    try:
        if any(store.followed for store in stores):
            return _followed(stores[0], stores[0].layout, methods[0].slopes, frames)
        return _example(stores, stores[0].layout, methods, frames, notes)
    except InputError as error:
        return f"Not drawn: {error}."


def _example(
    stores: Sequence[StoredRun],
    layout: Layout,
    methods: Sequence[MeasuredSlopes],
    frames: Sequence[str | Path] | None,
    notes: list[str],
) -> Example:
    """Measure the frame with the median total flux again in every method."""
    total = np.where(methods[0].valid, methods[0].slopes.flux, 0.0).sum(axis=1)
    number = int(np.argsort(total, kind="stable")[(len(total) - 1) // 2])
    frame = _frame(stores[0], number, frames)
    stages: dict[str, Stages] = {}
    for store, method in zip(stores, methods, strict=True):
        stages[method.name] = store.pipeline().explain(frame)
        notes += _disagreement(store, method, frame, number)
    estimator = not_none(stores[0].estimator)
    if len(stores) == 1 and (without := estimator.without_denoising()) is not None:
        stages[without.label] = stores[0].pipeline(without).explain(frame)
    return Example(layout, stages, number, steps=estimator.steps_shown, unit=stores[0].flux_unit)


def _followed(
    store: StoredRun, layout: Layout, slopes: Slopes, frames: Sequence[str | Path] | None
) -> Followed:
    """Return the spots that were followed and the frame of their picture."""
    number = farthest_frame(slopes)
    return Followed(_frame(store, number, frames), number, slopes, subtracted_reference(store.stored), layout)


def _frame(store: StoredRun, number: int, frames: Sequence[str | Path] | None) -> NDArray[Any]:
    """Return a frame of the files given, or of those that the run measured."""
    locations = list(frames) if frames is not None else store.sources
    if not locations:
        raise InputError(f"{store.path.name} does not say where its frames came from")
    known = store.stored.attributes
    reading = {"key": known.get("source_key") or None, "time_axis": known.get("source_time_axis")}
    with open_frames(locations, **reading) as source:
        return np.asarray(source.block(number, number + 1)[0])


def _disagreement(store: StoredRun, method: MeasuredSlopes, frame: NDArray[Any], number: int) -> list[str]:
    """Warn if the example frame, measured again, gives other slopes than those stored."""
    slopes = store.pipeline(reference=store.stored.attributes.get("reference"))(frame)
    valid = slopes.valid & method.valid[number]
    again = np.stack([slopes.x, slopes.y])[:, valid]
    distance = np.abs(again - np.stack([method.slopes.x[number], method.slopes.y[number]])[:, valid])
    if distance.size == 0 or distance.max() <= _SAME_POSITION_PX:
        return []
    names = {"frame": number, "file": store.path.name}
    return [_TEXT("stored.disagreement", **names, distance=distance.max())]


def _facts(stores: Sequence[StoredRun], methods: Sequence[MeasuredSlopes]) -> dict[str, str]:
    sources = list(dict.fromkeys(source for store in stores for source in store.sources))
    shown = ", ".join(sources[:4]) + (f" and {len(sources) - 4} more" if len(sources) > 4 else "")
    attributes = [store.stored.attributes for store in stores]
    facts = {"Slopes": ", ".join(str(store.path) for store in stores), "Sources": shown or "not stored"}
    for store, method in zip(stores, methods, strict=True):
        words = "not stored"
        if store.estimator is not None and store.layout is not None:
            words = store.estimator.in_words(len(store.layout), store.layout.pixels)
        facts["Settings" if len(methods) == 1 else f"Settings of {method.name!r}"] = words
    if any("reference" in of_run for of_run in attributes):
        facts["Reference"] = _TEXT["stored.reference"]
    versions = dict.fromkeys(str(of_run.get("faintspot_version", "unknown")) for of_run in attributes)
    return {**facts, "Measured with": f"faintspot {', '.join(versions)}"}
