"""A learnt controller against a plain model: the integrator that begins, the stroke, a copy from a file."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
)
from tests.loop.control.modal_cases import LEAK, Floats

from faintspot.loop.control.identification.predictive_control import PredictiveControl

LIMIT = 2.0
REFERENCE, FLAT = np.array([0.3, -0.2]), np.array([5.0, -4.0])
PLAIN_FRAMES = 60
"""In which the integrator drives at first."""


class Controls(RuleBasedStateMachine):
    """Rows of any kind, resets, and files."""

    learnt: PredictiveControl
    """Of a tip-tilt mirror; a subclass has it."""

    def __init__(self) -> None:
        super().__init__()
        loop = self.learnt._loop
        recorded = replace(loop.recorded, reference_slopes=REFERENCE, flat_command=FLAT)
        loop = replace(loop, recorded=recorded, largest_command=np.full(2, LIMIT))
        self.control = PredictiveControl(loop, self.learnt.model)
        self.copy: PredictiveControl | None = None
        self.last = REFERENCE
        self.start()

    def start(self, held: Floats | None = None) -> None:
        """Begin anew, here and in the copy."""
        for control in filter(None, (self.control, self.copy)):
            control.reset(held)
        self.sent = self.before = FLAT if held is None else np.clip(held, FLAT - LIMIT, FLAT + LIMIT)
        self.frames = 0

    def send(self, row: Floats) -> None:
        """Compare the commands of both with each other, and with those of the model where it has one."""
        earlier, self.before, self.sent = self.before, self.sent, self.control(row)
        if self.copy is not None:
            np.testing.assert_array_equal(self.copy(row), self.sent)
        self.frames += 1
        if self.frames < PLAIN_FRAMES and not (np.isfinite(row).any() and row.any()):
            # What is expected in place of these slopes is the last step, which does not act yet.
            most = np.abs(self.before - earlier) + 1e-9
            assert (np.abs(self.sent - FLAT - (1 - LEAK) * (self.before - FLAT)) <= most).all()

    @rule(count=st.sampled_from([1, 5, 70]), size=st.sampled_from([1e-3, 1.0, 30.0]), seed=st.integers(0, 99))
    def rows(self, count: int, size: float, seed: int) -> None:
        for row in REFERENCE + size * np.random.default_rng(seed).standard_normal((count, 2)):
            self.send(row)
        self.last = row

    @rule(count=st.integers(1, 80))
    def repeated(self, count: int) -> None:
        for _ in range(count):
            self.send(self.last)

    @rule(bad=st.sampled_from([np.nan, np.inf, -np.inf]), axes=st.sampled_from([[0], [1], [0, 1]]))
    def not_finite(self, bad: float, axes: list[int]) -> None:
        row = self.last.copy()
        row[axes] = bad
        self.send(np.full(2, bad) if len(axes) == 2 else row)

    @rule(value=st.sampled_from([1e5, -1e300]))
    def absurd(self, value: float) -> None:
        self.send(np.array([value, self.last[1]]))

    @rule(count=st.integers(1, 20))
    def zeros(self, count: int) -> None:
        for _ in range(count):
            self.send(np.zeros(2))

    @rule()
    def reset(self) -> None:
        self.start()

    @rule(held=st.tuples(*[st.floats(-2 * LIMIT, 2 * LIMIT)] * 2))
    def reset_to_a_shape(self, held: tuple[float, float]) -> None:
        self.start(FLAT + held)
        self.send(np.zeros(2))  # leaks, as nothing is on its way

    @rule()
    def save_and_load(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            self.control.save(Path(folder) / "controller.npz")
            self.copy = PredictiveControl.load(Path(folder) / "controller.npz")
        self.start()

    @precondition(lambda self: self.copy is not None)
    @rule()
    def go_on_with_the_copy(self) -> None:
        assert self.copy is not None
        self.control, self.copy = self.copy, None

    @invariant()
    def commands_are_finite_and_within_the_stroke(self) -> None:
        assert np.isfinite(self.sent).all()
        assert np.abs(self.sent - FLAT).max() <= LIMIT + 1e-9
