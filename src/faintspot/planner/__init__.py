"""The planner: which estimator, with which settings, for a camera, its spots and a star."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.compare.photometry import Photometry as Photometry
    from faintspot.planner.answer import Answer as Answer
    from faintspot.planner.loop_answer import LoopAnswer as LoopAnswer
    from faintspot.planner.loop_question import LoopQuestion as LoopQuestion
    from faintspot.planner.loop_tuning import tune_loop as tune_loop
    from faintspot.planner.promise import Promise as Promise
    from faintspot.planner.promise import check_promises as check_promises
    from faintspot.planner.question import Question as Question
    from faintspot.planner.recorded import question_from_frames as question_from_frames
    from faintspot.planner.tuning import tune as tune

_HOMES = {
    "Answer": "faintspot.planner.answer",
    "LoopAnswer": "faintspot.planner.loop_answer",
    "LoopQuestion": "faintspot.planner.loop_question",
    "Photometry": "faintspot.compare.photometry",
    "Promise": "faintspot.planner.promise",
    "Question": "faintspot.planner.question",
    "check_promises": "faintspot.planner.promise",
    "question_from_frames": "faintspot.planner.recorded",
    "tune": "faintspot.planner.tuning",
    "tune_loop": "faintspot.planner.loop_tuning",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
