"""Pictures, tables and the report page (HTML) of a slopes run or a study."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.report.page import slopes_report as slopes_report
    from faintspot.report.page import write_report as write_report
    from faintspot.report.pictures import layout_picture as layout_picture
    from faintspot.report.statistics import Arm as Arm
    from faintspot.report.stored import report_of_stored as report_of_stored
    from faintspot.report.study_page import report_of_study as report_of_study

# Imported at first use: matplotlib and jinja2 are optional, and slow to import.
_HOMES = {
    "Arm": "faintspot.report.statistics",
    "layout_picture": "faintspot.report.pictures",
    "report_of_stored": "faintspot.report.stored",
    "report_of_study": "faintspot.report.study_page",
    "slopes_report": "faintspot.report.page",
    "write_report": "faintspot.report.page",
}

__all__ = ["Arm", "layout_picture", "report_of_stored", "report_of_study", "slopes_report", "write_report"]


__getattr__ = lazy_attributes(__name__, _HOMES)
