"""Experiments: studies of slope errors, the planner, and closed loops compared by their Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.experiments.closed_loop.magnitude import run_magnitude as run_magnitude
    from faintspot.experiments.planner.answer import Answer as Answer
    from faintspot.experiments.planner.promise import Promise as Promise
    from faintspot.experiments.planner.promise import check_promises as check_promises
    from faintspot.experiments.planner.question import Question as Question
    from faintspot.experiments.planner.recorded import question_from_frames as question_from_frames
    from faintspot.experiments.planner.text import tune_figure as tune_figure
    from faintspot.experiments.planner.tuning import tune as tune
    from faintspot.experiments.running import WorkerPool as WorkerPool
    from faintspot.experiments.study.cell import measure_cell as measure_cell
    from faintspot.experiments.study.run import open_study as open_study
    from faintspot.experiments.study.run import run as run
    from faintspot.experiments.study.specification import StudySpecification as StudySpecification
    from faintspot.experiments.study.sweep import Cell as Cell
    from faintspot.experiments.study.sweep import Sweep as Sweep

__getattr__, __dir__, __all__ = lazy_names(__name__)
