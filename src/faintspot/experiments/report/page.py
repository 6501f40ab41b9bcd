"""The report page of a Monte-Carlo study: one HTML text that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.base.report.page import FigureWithData, Report, Section, configuration_section
from faintspot.base.report.texts import Texts
from faintspot.experiments.night.blocks import NIGHT_STORE, Night, load_night
from faintspot.experiments.night.page import night_sections
from faintspot.experiments.paper.claims import guidance, verdicts
from faintspot.experiments.paper.figures import (
    baselines_figure,
    kept_pixels_figure,
    sweep_figure,
    triple_picture,
)
from faintspot.experiments.paper.tables import baselines_section, gains_section
from faintspot.experiments.paper.whole import paper_rows, paper_section
from faintspot.experiments.report.estimators import (
    compares_estimators,
    estimator_figures,
    findings,
)
from faintspot.experiments.study.specification import StudySpecification
from faintspot.experiments.study.sweep import PARAMETERS
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX

if TYPE_CHECKING:
    import xarray


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

    store = night_folder(path) / NIGHT_STORE
    return study_report(open_study(path), load_night(store) if store.exists() else None)


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
    of_estimators = compares_estimators(dataset)
    subject = "Slope errors of the estimators" if of_estimators else "Slope errors with and without TV"
    version = attributes.get("faintspot_version", "unknown")
    values = {"done": done, "total": total, "widths": _widths_in_words(specification), "version": version}
    return Report(
        title=f"{subject}: study “{specification.name}”",
        facts=_TEXT.facts("study.facts", attributes, **values),
        sections=[
            *(_of_estimators(dataset) if of_estimators else _of_claims(dataset, night)),
            configuration_section(str(attributes["specification"]), "Specification"),
        ],
        warnings=_TEXT.lines("study.warnings", missing=(total - done) or None),
        warnings_title="This study is not finished",
        remark=_TEXT["study.remark"],
    )


def study_figures(dataset: xarray.Dataset) -> Iterator[FigureWithData]:
    """Yield the figures of a study, as far as its cells are finished.

    A sweep is drawn by the first word of its name, so that several make one figure. The paper's pictures
    (figures 1 and 5) come with the paper's sweeps only. A study with methods that know the spot has the
    figures of `faintspot.experiments.report.estimators` instead.
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
    for profile in sorted({str(name) for name in dataset["profile"].values}):
        figure = baselines_figure(dataset, profile)
        if figure is not None:
            yield figure


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


def _of_estimators(dataset: xarray.Dataset) -> list[Section]:
    return [
        _TEXT.section("sections.findings", findings(dataset)),
        *_figure_sections(dataset),
        baselines_section(dataset),
    ]


def _of_claims(dataset: xarray.Dataset, night: Night | None) -> list[Section]:
    return [
        paper_section(paper_rows(dataset, night), verdicts(dataset)),
        _TEXT.section("sections.guidance", *guidance(dataset)),
        baselines_section(dataset),
        gains_section(dataset),
        *_figure_sections(dataset),
        *([] if night is None else night_sections(night)),
    ]


def _figure_sections(dataset: xarray.Dataset) -> list[Section]:
    return [Section(figure.name, figure.title, [figure]) for figure in study_figures(dataset)]
