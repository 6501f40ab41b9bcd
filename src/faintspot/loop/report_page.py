"""The report page of a closed-loop experiment: one HTML text that needs nothing else."""

from __future__ import annotations

from pathlib import Path

from faintspot.loop.report_sections import (
    configuration_of,
    configuration_text,
    loop_sections,
    loop_warnings,
)
from faintspot.loop.verdict import LoopResults
from faintspot.report.page import POSITIONS, Page, configuration_section, html_of, write_page


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
    return write_page(_page(LoopResults.load(folder_of_results)), out_html)


def loop_report(results: LoopResults) -> str:
    """Return the report page of closed-loop results as HTML: self-contained, without scripts.

    Raises
    ------
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    return html_of(_page(results))


def _page(results: LoopResults) -> Page:
    configuration = configuration_of(results)
    name = "" if configuration is None else f": “{configuration.name}”"
    return Page(
        title=f"Closed loop with and without TV{name}",
        facts=_facts(results),
        sections=[*loop_sections(results), configuration_section(configuration_text(results))],
        warnings=loop_warnings(results),
        remark=POSITIONS,
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
