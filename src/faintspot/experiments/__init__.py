"""Experiments: studies of slope errors, the planner, and closed loops compared by their Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.experiments.answer import Answer as Answer
    from faintspot.experiments.answer_figures import loop_figure as loop_figure
    from faintspot.experiments.answer_figures import tune_figure as tune_figure
    from faintspot.experiments.budget import run_budget as run_budget
    from faintspot.experiments.cell import measure_cell as measure_cell
    from faintspot.experiments.loop_answer import LoopAnswer as LoopAnswer
    from faintspot.experiments.loop_question import LoopQuestion as LoopQuestion
    from faintspot.experiments.loop_tuning import tune_loop as tune_loop
    from faintspot.experiments.magnitude import run_magnitude as run_magnitude
    from faintspot.experiments.promise import Promise as Promise
    from faintspot.experiments.promise import check_promises as check_promises
    from faintspot.experiments.question import Question as Question
    from faintspot.experiments.recorded import question_from_frames as question_from_frames
    from faintspot.experiments.specification import StudySpecification as StudySpecification
    from faintspot.experiments.study import open_study as open_study
    from faintspot.experiments.study import run as run
    from faintspot.experiments.sweep import Cell as Cell
    from faintspot.experiments.sweep import Sweep as Sweep
    from faintspot.experiments.tuning import tune as tune

_NAMES = {
    "answer": "Answer",
    "answer_figures": "loop_figure tune_figure",
    "budget": "run_budget",
    "cell": "measure_cell",
    "loop_answer": "LoopAnswer",
    "loop_question": "LoopQuestion",
    "loop_tuning": "tune_loop",
    "magnitude": "run_magnitude",
    "promise": "Promise check_promises",
    "question": "Question",
    "recorded": "question_from_frames",
    "specification": "StudySpecification",
    "study": "open_study run",
    "sweep": "Cell Sweep",
    "tuning": "tune",
}
_HOMES = {name: f"{__name__}.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
