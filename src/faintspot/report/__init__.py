"""How every picture is drawn, and one self-contained page (HTML) made of sections.

What a page says lives with whom it is about: recorded slopes (`faintspot.recorded`), a study, a closed loop.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.recorded.layout_picture import layout_picture as layout_picture
    from faintspot.recorded.page import slopes_report as slopes_report
    from faintspot.recorded.report_of_stored import report_of_stored as report_of_stored
    from faintspot.recorded.statistics import Arm as Arm
    from faintspot.recorded.statistics import MeasuredSlopes as MeasuredSlopes
    from faintspot.report.page import write_report as write_report
    from faintspot.study.page import report_of_study as report_of_study

# Imported at first use: matplotlib and jinja2 are optional, and slow to import.
_HOMES = {
    "Arm": "faintspot.recorded.statistics",
    "MeasuredSlopes": "faintspot.recorded.statistics",
    "layout_picture": "faintspot.recorded.layout_picture",
    "report_of_stored": "faintspot.recorded.report_of_stored",
    "report_of_study": "faintspot.study.page",
    "slopes_report": "faintspot.recorded.page",
    "write_report": "faintspot.report.page",
}

__all__ = [
    "Arm",
    "MeasuredSlopes",
    "layout_picture",
    "report_of_stored",
    "report_of_study",
    "slopes_report",
    "write_report",
]


__getattr__ = lazy_attributes(__name__, _HOMES)
