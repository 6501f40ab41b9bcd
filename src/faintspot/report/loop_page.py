"""The report page of a closed-loop experiment: one HTML text that needs nothing else."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import faintspot
from faintspot.errors import InputError, MissingExtraError
from faintspot.loop.verdict import LoopResults
from faintspot.report import drawing
from faintspot.report.loop_sections import (
    LoopSection,
    configuration_of,
    configuration_text,
    loop_sections,
    loop_warnings,
)
from faintspot.report.pictures import write_file
from faintspot.report.sections import Picture, Section
from faintspot.report.study_page import svg
from faintspot.study.figure_data import StudyFigure

_CSS_PIXELS_PER_INCH = 100


@dataclass(frozen=True)
class _Drawn:
    """A figure drawn once: for the page, and as files."""

    picture: Picture
    files: dict[str, bytes]
    """Contents by name."""


def write_loop_report(folder_of_results: str | Path, out_html: str | Path) -> list[Path]:
    """Write the report of what `faintspot loop` left in a folder, finished or not.

    Beside the page, a folder holds each figure as PNG and SVG and its numbers as CSV.

    Returns
    -------
    list of Path
        The files written, the page first.

    Raises
    ------
    InputError
        When there are no results, or a file cannot be written.
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    path = Path(out_html)
    results = LoopResults.load(folder_of_results)
    sections = loop_sections(results)
    drawn = {figure.name: _draw(figure) for section in sections for figure in section.figures}
    write_file(path, _page(results, sections, drawn).encode("utf-8"))
    beside = path.with_name(f"{path.stem}-figures")
    try:
        beside.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{beside}: {error.strerror}: choose another place") from None
    written = [path]
    for item in drawn.values():
        for name, content in item.files.items():
            written.append(beside / name)
            write_file(written[-1], content)
    return written


def loop_report(results: LoopResults) -> str:
    """Return the report page of closed-loop results as HTML: self-contained, without scripts.

    Raises
    ------
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    sections = loop_sections(results)
    return _page(results, sections, {f.name: _draw(f) for section in sections for f in section.figures})


def _draw(figure: StudyFigure) -> _Drawn:
    width = round(figure.figure.get_size_inches()[0] * _CSS_PIXELS_PER_INCH)
    png = drawing.png(figure.figure)
    figure.figure.set_layout_engine("none")  # it has its layout now, which takes long to find
    vector = svg(figure.figure)
    uri = "data:image/svg+xml;base64," + base64.b64encode(vector).decode("ascii")
    contents = {"png": png, "svg": vector, "csv": figure.csv().encode()}
    return _Drawn(
        Picture(uri, width, figure.title, figure.caption),
        {f"{figure.name}.{ending}": content for ending, content in contents.items()},
    )


def _page(results: LoopResults, sections: list[LoopSection], drawn: dict[str, _Drawn]) -> str:
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError("jinja2", "web", "Making a report page") from None
    text = files("faintspot.report").joinpath("templates/report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    configuration = configuration_of(results)
    name = "" if configuration is None else f": “{configuration.name}”"
    return environment.from_string(text).render(
        title=f"Closed loop with and without TV{name}",
        facts=_facts(results),
        warnings=loop_warnings(results),
        sections=[
            Section(
                section.name,
                section.title,
                section.text,
                section.tables,
                [drawn[figure.name].picture for figure in section.figures],
                section.missing,
            )
            for section in sections
        ],
        configuration=configuration_text(results).strip(),
        version=faintspot.__version__,
    )


def _facts(results: LoopResults) -> dict[str, str]:
    """Return what was simulated, in words, for the top of the page."""
    configuration = configuration_of(results)
    if configuration is None:
        return {}
    telescope, sensor, air = configuration.telescope, configuration.sensor, configuration.atmosphere
    camera, control = configuration.camera, configuration.control
    r0 = f"{air.r0_m[0]:g} to {air.r0_m[1]:g}" if isinstance(air.r0_m, tuple) else f"{air.r0_m:g}"
    return {
        "Telescope": f"{telescope.diameter_m:g} m, central obstruction {telescope.obstruction:g} of the "
        "diameter",
        "Sensor": f"{sensor.subapertures} × {sensor.subapertures} sub-apertures of "
        f"{configuration.subaperture_m:.2g} m, "
        f"{sensor.pixels} × {sensor.pixels} px, {sensor.wavelength_m * 1e9:.0f} nm",
        "Air": f"r0 {r0} m at 500 nm, outer scale {air.outer_scale_m:g} m, {len(air.fraction)} layers",
        "Camera": f"read noise {camera.read_noise_e / camera.em_gain:.3g} e⁻"
        + (f", multiplication gain {camera.em_gain:g}" if camera.em_gain > 1 else ""),
        "Star": f"{configuration.photons:g} photo-electrons of a sub-aperture in a frame, where not varied",
        "Control": f"{control.frame_rate_hz:g} frames/s, {control.mode} loop; the command computed from "
        "frame k acts "
        f"first during frame k + {control.delay_frames}",
        "Wavefront": "that of the middle of each exposure stands for all of it",
        "Strehl ratio": f"on axis at {configuration.science.wavelength_m * 1e6:.3g} µm",
    }
