"""The section of a report page that shows the wavefronts of its arms."""

from __future__ import annotations

from collections.abc import Mapping

from faintspot.report.page import Section, Table
from faintspot.report.texts import Texts
from faintspot.sensor.layout import Layout
from faintspot.wavefront import Wavefront
from faintspot.wavefront.figure import wavefront_figure
from faintspot.wavefront.words import mode_table, remarks, rms_table

_TEXT = Texts("faintspot.recorded")


def wavefront_sections(wavefronts: Mapping[str, Wavefront | str], layout: Layout | None) -> list[Section]:
    """Return the section, none without wavefronts; a text in place of one says why it is missing."""
    if layout is None or not wavefronts:
        return []
    tables, figures, missing = [], [], []
    text = [_TEXT["wavefront.about"]]
    for number, (name, found) in enumerate(wavefronts.items()):
        if isinstance(found, str):
            missing.append(f"Wavefront of {name!r}: {found}.")
            continue
        text += [line for line in remarks(found) if line not in text]
        header, rows = rms_table(found)
        tables.append(Table(header, rows, caption=name))
        header, rows = mode_table(found)
        tables.append(Table(header, rows, caption=name, folded=f"Coefficients of {name!r}"))
        figures.append(wavefront_figure(found, layout, name, file=f"wavefront-{number + 1}"))
    return [Section("wavefront", "Wavefront", text, tables, figures, missing=" ".join(missing))]
