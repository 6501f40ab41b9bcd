"""The report page of a Monte-Carlo study: one HTML text that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.base.report.page import FigureWithData, Report, Section, configuration_section
from faintspot.base.report.plots import Line, Panel, draw
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import knows_the_spot, label_of, style_of
from faintspot.experiments.night.page import night_sections
from faintspot.experiments.night.protocol import NIGHT_FILE, Night
from faintspot.experiments.paper import claims
from faintspot.experiments.paper.figures import (
    axis_of_study,
    baselines_figure,
    kept_pixels_figure,
    sweep_figure,
    triple_picture,
)
from faintspot.experiments.study.curves import measured_profiles, names_of, shared_in_words
from faintspot.experiments.study.specification import BEST, CORRECTED, StudySpecification
from faintspot.experiments.study.sweep import PARAMETERS, STANDARD
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX

if TYPE_CHECKING:
    import xarray


_KINDS = ("error", "photon_efficiency", "gain")
_ROW_HEIGHT = 4.4
_FEWEST_POINTS = 3
_BOUND: dict[str, Any] = {"color": "black", "lw": 3, "alpha": 0.35, "zorder": 1}
_BEST_OF_CELL: dict[str, Any] = {"ls": "", "marker": "o", "ms": 15, "mfc": "none", "mec": "black", "mew": 1.4}
_SCALES: dict[str, dict[str, Any]] = {
    "error": {"y_ticks": (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2)},
    "photon_efficiency": {"levels": {1.0: {**_BOUND, "label": "Cramer-Rao bound"}}, "y_range": (0, 1.35)},
    "gain": {"levels": {1.0: _BOUND}},
    "corrected_rms": {
        "x_ticks": (0.3, 0.5, 1, 2, 3, 5, 10),
        "y_ticks": (0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1, 2),
    },
}


def compares_estimators(dataset: xarray.Dataset) -> bool:
    """Whether a study has methods that know the spot."""
    return any(map(knows_the_spot, names_of(dataset, "estimator")))


@dataclass(frozen=True)
class _Group:
    """Panels of cells that have all but some parameters in common."""

    common: Mapping[str, Any]
    panels: Mapping[str, list[int]]
    """Cells by increasing value of what varies, by the title of their panel."""

    @property
    def name(self) -> str:
        """A short name, different for every group."""
        numbers = {name: value for name, value in self.common.items() if name != "profile"}
        changed = {name: value for name, value in numbers.items() if value != STANDARD[name]}
        words = [f"{name.partition('_')[0]}{value:g}" for name, value in changed.items()]
        return "-".join([self.common["profile"], *words])


def estimator_figures(dataset: xarray.Dataset) -> Iterator[FigureWithData]:
    """Yield the figures of a study that compares estimators, as far as its cells are finished.

    Cells that differ in flux (or, speckled ones, in d/r0) alone are a line, where there are at least three.
    """
    for group in _groups(dataset, "flux_e", ("read_noise_e",), speckled=False):
        rows = [
            [_panel(dataset.isel(cell=cells).sel(mode=BEST), kind, "flux_e", title) for kind in _KINDS]
            for title, cells in group.panels.items()
        ]
        yield _figure("estimators", group, rows)
    for group in _groups(dataset, "d_over_r0", ("read_noise_e", "flux_e"), speckled=True):
        speckled = dataset.sel(mode=CORRECTED if CORRECTED in names_of(dataset, "mode") else BEST)
        panels = [
            _panel(speckled.isel(cell=cells), "corrected_rms", "d_over_r0", title)
            for title, cells in group.panels.items()
        ]
        yield _figure("speckled", group, [panels[first : first + 2] for first in range(0, len(panels), 2)])


def _groups(dataset: xarray.Dataset, axis: str, by: Sequence[str], *, speckled: bool) -> Iterator[_Group]:
    """Yield the groups of cells that differ in `axis`, within a panel, and in `by`, between panels."""
    common = [name for name in PARAMETERS if name not in (axis, *by)]
    done = dataset["done"].values & ((dataset["d_over_r0"].values > 0) == speckled)
    for values, cells in claims.grouped(dataset, np.flatnonzero(done).tolist(), common, axis).items():
        parts = claims.grouped(dataset, cells, by, axis)
        panels = {
            claims.in_words(by, key): part for key, part in parts.items() if len(part) >= _FEWEST_POINTS
        }
        if panels:
            yield _Group(dict(zip(common, values, strict=True)), panels)


def _figure(kind: str, group: _Group, rows: list[list[Panel]]) -> FigureWithData:
    title, caption = f"{_TEXT[f'{kind}.title']}: {shared_in_words(group.common)}", _TEXT(f"{kind}.caption")
    height = _ROW_HEIGHT * len(rows) + 0.9
    return FigureWithData.of(f"{kind}-{group.name}", title, caption, rows, height, heading=title)


def _panel(cells: xarray.Dataset, kind: str, axis: str, title: str) -> Panel:
    """Return a variable of every method along an axis."""
    x, values = cells[axis].values, cells[kind]
    errors, scale = cells.get(f"{kind}_se"), {**axis_of_study(axis), **_SCALES[kind]}
    lines = []
    for method in names_of(cells, "estimator"):
        error = None if errors is None else errors.sel(estimator=method).values
        style, line = style_of(method), "-" if knows_the_spot(method) else "--"
        drawn = {"color": style.colour, "marker": style.marker, "ms": 8 if style.marker == "*" else 5.5}
        drawn |= {"lw": 1.8, "ls": line, "elinewidth": 1, "zorder": 3}
        lines.append(Line(label_of(method), x, values.sel(estimator=method).values, error, drawn))
    if kind == "error":
        lines.append(Line("Cramer-Rao bound", x, cells["bound"].values, style=_BOUND))
        scale["levels"] = {float(cells["position_range_px"][0]) / 2: {"ls": ":"}}
    elif kind == "corrected_rms":
        best = values.min("estimator").values
        lines.append(Line("best", x, best, style={**_BEST_OF_CELL, "zorder": 4}, in_legend=False))
        scale["y_range"] = (0.85 * best.min(), min(4.0, 1.2 * float(np.nanmax(values))))
    return Panel(lines, y=_TEXT[f"estimator_axes.{kind}"], title=title, **scale)


_TEXT = Texts("faintspot.experiments")
_KEPT_PIXELS = "fig5"


def report_of_study(path: str | Path) -> Report:
    """Return the report of a stored study, finished or not.

    Raises
    ------
    InputError
        When there is no study, or none of its cells is finished.
    MissingExtraError
        When xarray, zarr or matplotlib is not installed.
    """
    from faintspot.experiments.study.run import open_study

    file = night_folder(path) / NIGHT_FILE
    return study_report(open_study(path), Night.load(file) if file.exists() else None)


def night_folder(path: str | Path) -> Path:
    """Return where the night that belongs to the paper's study is, beside the study."""
    return derived(path, "-night")


def study_report(dataset: xarray.Dataset, night: Night | None = None) -> Report:
    """Return the report of a study.

    Parameters
    ----------
    dataset : xarray.Dataset
        What a run of a study returned; it may be unfinished, which the page says.
    night : Night, optional
        The paper's observations.

    Raises
    ------
    InputError
        When no cell is finished.
    MissingExtraError
        When matplotlib is not installed.
    """
    if not bool(dataset["done"].any()):
        raise InputError(f"study: none of its {dataset.sizes['cell']} cells is finished: run it first")
    dataset = dataset.load()
    attributes = dataset.attrs
    done, total = int(dataset["done"].sum()), dataset.sizes["cell"]
    specification = StudySpecification.from_text(str(attributes["specification"]))
    figures = [Section(figure.name, figure.title, [figure]) for figure in study_figures(dataset)]
    if compares_estimators(dataset):
        subject = "Slope errors of the estimators"
        sections = [*figures, claims.baselines_section(dataset)]
    else:
        subject = "Slope errors with and without TV"
        sections = [
            claims.paper_section(claims.paper_rows(dataset, night), claims.verdicts(dataset)),
            _TEXT.section("sections.guidance", *claims.guidance(dataset)),
            claims.baselines_section(dataset),
            claims.gains_section(dataset),
            *figures,
            *([] if night is None else night_sections(night)),
        ]
    version = attributes.get("faintspot_version", "unknown")
    values = {"done": done, "total": total, "widths": _widths_in_words(specification), "version": version}
    return Report(
        title=f"{subject}: study “{specification.name}”",
        facts=_TEXT.facts("study.facts", attributes, **values),
        sections=[*sections, configuration_section(str(attributes["specification"]), "Specification")],
        warnings=_TEXT.lines("study.warnings", missing=(total - done) or None),
        warnings_title="This study is not finished",
        remark=_TEXT["study.remark"],
    )


def study_figures(dataset: xarray.Dataset) -> Iterator[FigureWithData]:
    """Yield the figures of a study, as far as its cells are finished.

    A sweep is drawn by the first word of its name, so that several make one figure. The paper's pictures
    (figures 1 and 5) come with the paper's sweeps only. A study with methods that know the spot has the
    figures of `faintspot.experiments.report` instead.
    """
    if compares_estimators(dataset):
        yield from estimator_figures(dataset)
        return
    groups = _cells_by_figure(dataset)
    if _is_paper(groups):
        yield triple_picture()
    for name, cells in groups.items():
        if name == _KEPT_PIXELS:
            figure = kept_pixels_figure(dataset)
            if figure is not None:
                yield figure
        elif cells:
            yield sweep_figure(dataset, cells, name, _TEXT["paper_figures"].get(name, name))
    for profile in measured_profiles(dataset):
        figure = baselines_figure(dataset, profile)
        if figure is not None:
            yield figure


def plot_study(dataset: xarray.Dataset, name: str | None, axes: Any) -> Any:
    """Draw what `StudyFigures.plot` returns, with the figure's legend in its first panel."""
    names = []
    for figure in study_figures(dataset):
        if name in (None, figure.name) and figure.rows:
            places = draw(figure.rows, axes)
            for legend in figure.figure.legends:
                words = [text.get_text() for text in legend.get_texts()]
                np.ravel(places)[0].legend(legend.legend_handles, words, frameon=False, fontsize="small")
            return places
        names.append(figure.name)
    raise InputError(f"figure = {name!r}: expected one of {', '.join(names) or 'those of finished cells'}")


def _cells_by_figure(dataset: xarray.Dataset) -> dict[str, list[int]]:
    """Return the finished cells of each figure: of all sweeps with the same first word."""
    specification = StudySpecification.from_text(str(dataset.attrs["specification"]))
    columns = [dataset[name].values.tolist() for name in PARAMETERS]
    done = dataset["done"].values
    index = {values: i for i, values in enumerate(zip(*columns, strict=True)) if done[i]}
    groups: dict[str, dict[int, None]] = {}
    for sweep in specification.sweeps:
        group = groups.setdefault(sweep.name.split()[0], {})
        for cell in sweep.cells():
            values = tuple(getattr(cell, name) for name in PARAMETERS)
            if values in index:
                group[index[values]] = None
    return {name: list(group) for name, group in sorted(groups.items())}


def _is_paper(names: Iterable[str]) -> bool:
    return all(name in _TEXT["paper_figures"] or name == _KEPT_PIXELS for name in names)


def _widths_in_words(specification: StudySpecification) -> str:
    widths = [f"{fwhm:.2f} s ({profile})" for profile, fwhm in FWHM_OF_SIZE_1_PX.items()]
    is_paper = _is_paper(sweep.name.split()[0] for sweep in specification.sweeps)
    largest = 2 * FWHM_OF_SIZE_1_PX["diffraction"] if is_paper else None
    return _TEXT("study.widths", widths=", ".join(widths), largest=largest)
