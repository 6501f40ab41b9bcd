"""The report page of a Monte-Carlo study: one HTML text that needs nothing else."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from faintspot.errors import InputError, MissingExtraError
from faintspot.report import drawing
from faintspot.report.pictures import write_file
from faintspot.study.baselines import ARM_NAMES, against_tv
from faintspot.study.claims import fixed_mode, verdicts
from faintspot.study.efficiency import compares_estimators, findings
from faintspot.study.estimator_figures import estimator_figures
from faintspot.study.figure_data import StudyFigure, csv_text, mode_in_words
from faintspot.study.figures import baselines_figure, kept_pixels_figure, sweep_figure
from faintspot.study.gains import gains_by_mode
from faintspot.study.guidance import guidance
from faintspot.study.specification import StudySpecification
from faintspot.study.sweep import PARAMETERS
from faintspot.study.triple_picture import triple_picture
from faintspot.study.verdicts import Finding, Outcome, Verdict

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

_CSS_PIXELS_PER_INCH = 100
_MOST_CASES_SHOWN = 3  # in the verdict table; the page lists all of them below it
_PAPER_TITLES = {
    "fig2": "Figure 2: R against signal, by spot size",
    "fig3": "Figure 3: R against signal, by sub-aperture size",
    "fig4": "Figure 4: R against signal, by read noise",
    "fig6": "Figure 6: R against signal, spots elongated 3 times, by read noise",
    "fig7": "Figure 7: R against signal with a 16 e- camera, by spot size",
}
_KEPT_PIXELS = "fig5"
_MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml", "csv": "text/csv"}


@dataclass(frozen=True)
class _Picture:
    """A figure drawn once: for the page as data URIs, for the folder as bytes."""

    name: str
    title: str
    caption: str
    width: int
    files: dict[str, bytes]
    """Contents by ending: png, svg, csv."""

    def uri(self, ending: str) -> str:
        """Return a file as a data URI."""
        content = base64.b64encode(self.files[ending]).decode("ascii")
        return f"data:{_MEDIA_TYPES[ending]};base64,{content}"


def report_of_study(path: str | Path) -> str:
    """Return the report page (HTML) of a stored study, finished or not.

    Raises
    ------
    InputError
        When there is no study, or none of its cells is finished.
    MissingExtraError
        When xarray, zarr, matplotlib or jinja2 is not installed.
    """
    from faintspot.study.store import open_study

    return study_report(open_study(path))


def study_report(dataset: xarray.Dataset) -> str:
    """Return the report page of a study as HTML: self-contained, without scripts.

    Parameters
    ----------
    dataset : xarray.Dataset
        What a run of a study returned; it may be unfinished, which the page says.

    Raises
    ------
    InputError
        When no cell is finished.
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    dataset = _checked(dataset)
    return _page(dataset, _pictures(dataset))


def write_study_report(dataset: xarray.Dataset, path: str | Path) -> list[Path]:
    """Write the page and, in a folder beside it, each figure as PNG and SVG and its numbers as CSV.

    Returns
    -------
    list of Path
        The files written, the page first.

    Raises
    ------
    InputError
        As `study_report`, and when a file cannot be written.
    """
    path, dataset = Path(path), _checked(dataset)
    pictures = _pictures(dataset)
    write_file(path, _page(dataset, pictures).encode("utf-8"))
    folder = path.with_name(f"{path.stem}-figures")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}: choose another place") from None
    written = [path]
    for picture in pictures:
        for ending, content in picture.files.items():
            written.append(folder / f"{picture.name}.{ending}")
            write_file(written[-1], content)
    return written


def study_figures(dataset: xarray.Dataset) -> Iterator[StudyFigure]:
    """Yield the figures of a study, as far as its cells are finished.

    A sweep is drawn by the first word of its name, so that several make one figure. The paper's pictures
    (figures 1 and 5) come with the paper's sweeps only. A study with arms that know the spot has the figures
    of `faintspot.study.estimator_figures` instead.
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
            yield sweep_figure(dataset, cells, name, _PAPER_TITLES.get(name, name))
    for profile in sorted({str(name) for name in dataset["profile"].values}):
        figure = baselines_figure(dataset, profile)
        if figure is not None:
            yield figure


@drawing.styled
def svg(figure: Figure) -> bytes:
    """Return a figure as an SVG picture, the same bytes for the same figure."""
    import matplotlib

    matplotlib.rcParams["svg.hashsalt"] = "faintspot"
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def _checked(dataset: xarray.Dataset) -> xarray.Dataset:
    if not bool(dataset["done"].any()):
        raise InputError(f"study: none of its {dataset.sizes['cell']} cells is finished: run it first")
    return dataset.load()


def _cells_by_figure(dataset: xarray.Dataset) -> dict[str, list[int]]:
    """Return the finished cells of each figure: of all sweeps with the same first word."""
    specification = StudySpecification.from_text(str(dataset.attrs["specification"]))
    columns = [dataset[name].values.tolist() for name in PARAMETERS]
    done = dataset["done"].values
    place = {values: i for i, values in enumerate(zip(*columns, strict=True)) if done[i]}
    groups: dict[str, dict[int, None]] = {}
    for sweep in specification.sweeps:
        group = groups.setdefault(sweep.name.split()[0], {})
        for cell in sweep.cells():
            values = tuple(getattr(cell, name) for name in PARAMETERS)
            if values in place:
                group[place[values]] = None
    return {name: list(group) for name, group in sorted(groups.items())}


def _is_paper(names: Iterable[str]) -> bool:
    return all(name in _PAPER_TITLES or name == _KEPT_PIXELS for name in names)


def _page(dataset: xarray.Dataset, pictures: list[_Picture]) -> str:
    of_estimators = compares_estimators(dataset)
    judged = [] if of_estimators else verdicts(dataset)  # the paper's arms have no search range
    fixed = mode_in_words(fixed_mode(dataset))
    attributes = dataset.attrs
    done, total = int(dataset["done"].sum()), dataset.sizes["cell"]
    return _render(
        title=f"{_subject(of_estimators)}: study “{_name(dataset)}”",
        findings=findings(dataset) if of_estimators else [],
        of_estimators=of_estimators,
        facts={
            "Cells": f"{done} of {total} finished",
            "Realisations": f"{attributes['n']} a cell: settings chosen on one half, scored on the other",
            "Slope error R": "mean of (|dx| + |dy|) / 2; ± one standard error, brackets 95 % intervals",
            "±1 px, ±4 px": "the range that true positions were drawn from, on each axis",
            "Seed": str(attributes["seed"]),
        },
        unfinished=total - done,
        summary=_summary(judged, fixed),
        verdicts=[_verdict_row(item) for item in judged],
        fixed=fixed,
        cases=[
            [str(item.number), mode_in_words(finding.mode), case.where, case.finding, case.outcome.value]
            for item in judged
            for finding in (item.best, item.fixed)
            for case in finding.cases
        ],
        cases_csv=_csv_uri(_cases_csv(judged)),
        guidance=[] if of_estimators else guidance(dataset),
        baselines=_baselines_rows(dataset),
        gain_modes=[mode_in_words(str(mode)) for mode in dataset["mode"].values],
        gains=[] if of_estimators else _gains_rows(dataset),
        pictures=pictures,
        specification=str(attributes["specification"]).strip(),
        version=attributes.get("faintspot_version", ""),
    )


def _subject(of_estimators: bool) -> str:
    return "Slope errors of the estimators" if of_estimators else "Slope errors with and without TV"


def _name(dataset: xarray.Dataset) -> str:
    return StudySpecification.from_text(str(dataset.attrs["specification"])).name


def _summary(judged: list[Verdict], fixed: str) -> str:
    def counted(outcomes: list[Outcome]) -> str:
        counts = [(outcome.value, outcomes.count(outcome)) for outcome in Outcome]
        return ", ".join(f"{outcome} {n}" for outcome, n in counts if n)

    best, other, both = (
        counted([getattr(item, name).outcome if name else item.outcome for item in judged])
        for name in ("best", "fixed", "")
    )
    return f"Of {len(judged)} claims: best k: {best}; {fixed}: {other}; both together: {both}"


def _verdict_row(item: Verdict) -> dict[str, Any]:
    return {
        "number": item.number,
        "claim": item.claim,
        "rule": item.rule,
        "outcome": item.outcome.value,
        "kind": _css_class(item.outcome),
        "modes": [_cell_of_table(finding) for finding in (item.best, item.fixed)],
    }


def _css_class(outcome: Outcome) -> str:
    return outcome.name.lower().replace("_", "-")


def _cell_of_table(finding: Finding) -> dict[str, Any]:
    """Return a mode's outcome and its first cases, of different outcomes where there are any."""
    shown = list({case.outcome: case for case in reversed(finding.cases)}.values())[::-1]
    shown += [case for case in finding.cases if case not in shown]
    shown = sorted(shown[:_MOST_CASES_SHOWN], key=list(finding.cases).index)
    return {
        "outcome": finding.outcome.value,
        "kind": _css_class(finding.outcome),
        "count": finding.in_words(),
        "cases": [{"where": c.where, "finding": c.finding, "outcome": c.outcome.value} for c in shown],
        "more": len(finding.cases) - len(shown),
    }


def _cases_csv(judged: list[Verdict]) -> str:
    rows = [
        [item.number, item.claim, finding.mode, case.where, case.finding, case.outcome.value]
        for item in judged
        for finding in (item.best, item.fixed)
        for case in finding.cases
    ]
    return csv_text(["number", "claim", "mode", "where", "finding", "outcome"], rows)


def _baselines_rows(dataset: xarray.Dataset) -> list[list[str]]:
    modes = [mode for mode in ("best", fixed_mode(dataset)) if mode in dataset["mode"].values]
    return [
        [
            ARM_NAMES[row.arm],
            row.profile,
            mode_in_words(mode),
            str(row.cells),
            str(row.smaller),
            str(row.larger),
            str(row.cells - row.smaller - row.larger),
            str(row.smallest),
            f"{row.mean_ratio:.3f}",
        ]
        for mode in modes
        for row in against_tv(dataset, mode)
    ]


def _gains_rows(dataset: xarray.Dataset) -> list[list[str]]:
    modes = [str(mode) for mode in dataset["mode"].values]
    return [
        [
            configuration.in_words(),
            *("–" if (gain := gains.get(mode)) is None else gain.in_words() for mode in modes),
        ]
        for configuration, gains in gains_by_mode(dataset).items()
    ]


def _pictures(dataset: xarray.Dataset) -> list[_Picture]:
    return [_picture(item) for item in study_figures(dataset)]


def _picture(item: StudyFigure) -> _Picture:
    width = round(item.figure.get_size_inches()[0] * _CSS_PIXELS_PER_INCH)
    png = drawing.png(item.figure)
    item.figure.set_layout_engine("none")  # it has its layout now, which takes long to find
    contents = {"png": png, "svg": svg(item.figure), "csv": item.csv().encode()}
    return _Picture(item.name, item.title, item.caption, width, contents)


def _csv_uri(text: str) -> str:
    return "data:text/csv;charset=utf-8," + quote(text)


def _render(**values: object) -> str:
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError("jinja2", "web", "Making a report page") from None
    templates = files("faintspot.report").joinpath("templates")
    slopes_page = templates.joinpath("report.html").read_text(encoding="utf-8")
    style = slopes_page.partition("<style>")[2].partition("</style>")[0]  # all pages look the same
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(templates.joinpath("study.html").read_text(encoding="utf-8"))
    return template.render(style=style, **values)
