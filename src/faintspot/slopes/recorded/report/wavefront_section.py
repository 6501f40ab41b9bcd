"""The section of a report page that shows the wavefronts of its methods."""

from __future__ import annotations

from collections.abc import Mapping

from faintspot.base.errors import InputError
from faintspot.base.report.page import Section, Table
from faintspot.base.report.texts import Texts
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront import fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.words import mode_table, remarks, rms_table

_TEXT = Texts("faintspot.slopes.recorded")


def wavefront_sections(slopes: Mapping[str, Slopes], layout: Layout | None) -> list[Section]:
    """Return the section with the wavefronts fitted to the slopes of each method; none without a layout."""
    if layout is None or not slopes:
        return []
    tables, figures, missing = [], [], []
    text = [_TEXT["wavefront.about"]]
    for number, (name, method_slopes) in enumerate(slopes.items()):
        try:
            wavefront = fit_wavefront(method_slopes, layout)
        except InputError as error:
            missing.append(f"Wavefront of {name!r}: {error}.")
            continue
        text += [line for line in remarks(wavefront) if line not in text]
        header, rows = rms_table(wavefront)
        tables.append(Table(header, rows, caption=name))
        header, rows = mode_table(wavefront)
        tables.append(Table(header, rows, caption=name, folded=f"Coefficients of {name!r}"))
        figures.append(wavefront_figure(wavefront, layout, name, file=f"wavefront-{number + 1}"))
    return [Section("wavefront", "Wavefront", text, tables, figures, missing=" ".join(missing))]
