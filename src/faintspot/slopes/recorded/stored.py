"""The report page of slopes that lie in files, and the figure of a sodium profile."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.flags import leave_out
from faintspot.base.report.page import FigureWithData, Report
from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, Line, Panel
from faintspot.base.report.texts import Texts
from faintspot.io import open_frames
from faintspot.io.frames import FrameSource
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.page import SlopesRun, slopes_report
from faintspot.slopes.recorded.pictures import Followed, farthest_frame
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.recorded.stored_run import StoredRun, open_run
from faintspot.slopes.spots.sodium import SodiumProfile

_TEXT = Texts("faintspot.slopes.recorded")


def profile_figure(profiles: Mapping[str, SodiumProfile]) -> FigureWithData:
    """Draw the density of profiles against altitude; the last one is emphasised."""
    *_, newest = profiles
    lines = []
    for index, (name, profile) in enumerate(profiles.items()):
        style: dict[str, object] = {"color": METHOD_COLOURS[1], "lw": 2.2}
        if name != newest:
            style = {"color": GREY, "lw": 1.6, "ls": ("--", ":", "-.")[index % 3]}
        label = f"{name}\n(mean {profile.mean_m / 1e3:.1f} km, std {profile.std_m / 1e3:.1f} km)"
        lines.append(Line(label, 1e3 * profile.density, profile.altitudes_m / 1e3, style=style))
    flux, height = "return flux per km of altitude", "altitude above sea level (km)"
    panel = Panel(lines, flux, height, x_range=(0, None), legend=True)
    return _TEXT.figure("sodium", [[panel]], 4.6, width=0.6 * WIDTH, legend="")


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
    total = np.where(methods[0].valid, methods[0].flux, 0.0).sum(axis=1)
    example_frame = int(np.argsort(total, kind="stable")[(len(total) - 1) // 2])
    followed, stages = None, dict[str, Stages]()
    if any(store.followed for store in stores):
        followed, reason = _followed(first, frames)
    else:
        stages, reason = _example(stores, methods, example_frame, frames, notes)
    steps = (first.estimator or TotalVariation).steps_shown
    run = SlopesRun(methods, first.layout, stages, None, example_frame, reason, steps, followed)
    return slopes_report(
        run,
        title=f"Slopes of {' and '.join(store.path.name for store in stores)}",
        facts=_facts(stores, methods),
        configurations=_configurations(stores, methods),
        warnings=list(dict.fromkeys([*_labelled_notes(stores, methods), *notes])),
    )


def _configurations(stores: Sequence[StoredRun], methods: Sequence[MeasuredSlopes]) -> dict[str, str]:
    """Return the configurations by what they are of: one where all are the same."""
    if len({store.text for store in stores}) == 1:
        return {"Configuration": stores[0].text}
    return {
        f"Configuration of {method.name}": store.text for store, method in zip(stores, methods, strict=True)
    }


def _labelled_notes(stores: Sequence[StoredRun], methods: Sequence[MeasuredSlopes]) -> list[str]:
    """Return the notes of all runs, with the name of their method where there are several."""
    notes = []
    for store, method in zip(stores, methods, strict=True):
        label = f"{method.name}: " if len(methods) > 1 else ""
        _, left_out = leave_out(method.flags, method.keep)
        notes += [label + note for note in store.notes]
        notes += [f"{label}{left_out}." if label else f"{left_out.capitalize()}."] if left_out else []
    return notes


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
    notes = []
    counts = [store.stored.n_finished for store in stores]
    if len(set(counts)) > 1:
        lengths = {"first": counts[0], "second": counts[1], "fewest": min(counts)}
        notes.append(_TEXT("stored.other_lengths", **lengths))
    sources = [store.sources for store in stores if store.sources]
    if len(sources) == 2 and sources[0] != sources[1]:
        notes.append(_TEXT["stored.other_sources"])
    methods = []
    for name, store in zip(_names(stores), stores, strict=True):
        slopes = Slopes.from_variables(store.stored.variables, min(counts), store.keep)
        methods.append(MeasuredSlopes.of(name, slopes))
    return methods, notes


def _names(stores: Sequence[StoredRun]) -> list[str]:
    """Name the methods by what they do where that tells them apart, else by their files."""
    names = [store.path.name if store.estimator is None else store.estimator.label for store in stores]
    if len(set(names)) < len(names):
        names = [store.path.name for store in stores]
    return names if len(set(names)) == len(names) else [str(store.path) for store in stores]


def _example(
    stores: Sequence[StoredRun],
    methods: Sequence[MeasuredSlopes],
    number: int,
    frames: Sequence[str | Path] | None,
    notes: list[str],
) -> tuple[dict[str, Stages], str]:
    """Measure the example frame again in every method; or return why that cannot be done."""
    if stores[0].layout is None:
        return {}, "Not drawn: the layout is not known."
    try:
        frame = _frame(stores[0], number, frames)
        stages: dict[str, Stages] = {}
        for store, method in zip(stores, methods, strict=True):
            stages[method.name] = store.pipeline().explain(frame)
            notes += _disagreement(store, method, frame, number)
        estimator = stores[0].estimator
        without = None if estimator is None else estimator.without_denoising()
        if len(stores) == 1 and without is not None:
            stages[without.label] = stores[0].pipeline(without).explain(frame)
    except InputError as error:
        return {}, f"Not drawn: {error}."
    return stages, ""


def _followed(store: StoredRun, frames: Sequence[str | Path] | None) -> tuple[Followed | None, str]:
    """Return the spots that were followed and the frame of their picture; or why there is none."""
    slopes = Slopes.from_variables(store.stored.variables, keep=store.keep)
    number = farthest_frame(slopes)
    n = slopes.x.shape[1]
    reference = np.asarray(store.stored.attributes.get("reference", np.zeros((n, 2))))
    reference = reference.reshape(n, 2) if reference.ndim == 2 else reference.reshape(2, n).T
    try:
        return Followed(_frame(store, number, frames), number, slopes, reference), ""
    except InputError as error:
        return None, f"Not drawn: {error}."


def _source(store: StoredRun, frames: Sequence[str | Path] | None) -> FrameSource:
    """Open the frames of a run."""
    locations = list(frames) if frames is not None else store.sources
    if not locations:
        raise InputError(f"{store.path.name} does not say where its frames came from")
    known = store.stored.attributes
    return open_frames(
        locations, key=known.get("source_key") or None, time_axis=known.get("source_time_axis")
    )


def _frame(store: StoredRun, number: int, frames: Sequence[str | Path] | None) -> NDArray[Any]:
    with _source(store, frames) as source:
        frame: NDArray[Any] = source.block(number, number + 1)[0]
    return frame


def _disagreement(store: StoredRun, method: MeasuredSlopes, frame: NDArray[Any], number: int) -> list[str]:
    """Warn if the example frame, measured again, gives other slopes than those stored."""
    slopes = store.pipeline(reference=store.stored.attributes.get("reference"))(frame)
    valid = slopes.valid & method.valid[number]
    again = np.stack([slopes.x, slopes.y])[:, valid]
    distance = np.abs(again - np.stack([method.x[number], method.y[number]])[:, valid])
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
