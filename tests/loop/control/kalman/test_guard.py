"""Choice of the controller that drives the mirror, by measured residuals."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from tests.patience import mostly_slow

from faintspot.loop.control.kalman.guard import AT_LIMIT, CHOOSE, LEFT_OUT, SURPRISE, new_guard

ALLOWED = {"residual": 1.1, "surprise": 1.5, "left_out": 1.3, "at_limit": 1.1}
LARGEST_RATIO = {"residual": 20.0, "surprise": 5.0, "left_out": 2.0, "at_limit": 2.0}
LEAST = {"residual": 1e-30, "surprise": 0.5, "left_out": 1.0, "at_limit": 1.0}


@dataclass
class SlowGuard:
    """The rule once more, in the order in which one would tell it."""

    computed: float
    wait: float
    patience: float
    filter_drives: bool
    evidence: float = 0.0
    next_wait: float = 500.0
    differences: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    frames: int = 0
    usual: dict[str, float] = field(default_factory=lambda: dict.fromkeys(ALLOWED, 0.0))
    usual_frames: int = 0
    excess: dict[str, float] = field(default_factory=lambda: dict.fromkeys(ALLOWED, 0.0))
    changed: bool = False

    def frame(self, learnt: float, plain: float, surprise: float, left_out: float, at_limit: float) -> None:
        """Take the measures of a frame."""
        self.differences.append((learnt - plain) / max(learnt + plain, 1e-30))
        if self.changed:
            self.changed, self.frames, self.evidence, self.ratios = False, 0, 0.0, []
            self.excess = dict.fromkeys(ALLOWED, 0.0)
        self.frames += 1
        residual = learnt if self.filter_drives else plain
        measures = {"residual": residual, "surprise": surprise, "left_out": left_out, "at_limit": at_limit}
        if not self.filter_drives:
            self._learn_the_usual(measures)
        elif self._fails(measures):
            runs_away = running_mean(self.ratios, 10 * self.patience) > 2.0
            self.wait = 20_000.0 if runs_away else self.next_wait
            self.next_wait = min(2 * self.next_wait, 20_000.0)
            self.filter_drives, self.changed, self.differences = False, True, []
            return
        elif self.frames > 2000:
            self.next_wait = 500.0
        if len(self.differences) >= 20:
            self._weigh()
        if self.wait > 0:
            self.wait -= 1
        elif self.evidence > 16:
            self.filter_drives, self.changed = not self.filter_drives, True

    def _learn_the_usual(self, measures: dict[str, float]) -> None:
        """Average the integrator's measures, but the first 15 after a change."""
        if self.frames > 15:
            self.usual_frames += 1
            for name, value in measures.items():
                share = 1 / min(self.usual_frames, 200 * self.patience)
                self.usual[name] += share * (value - self.usual[name])

    def _fails(self, measures: dict[str, float]) -> bool:
        """Add what exceeds the integrator's measures; return whether that of any is too much."""
        usual = dict(self.usual)
        if self.usual_frames < 20:
            usual = {"residual": 4 * self.computed, "surprise": 4.0, "left_out": math.inf}
        usual["at_limit"] = 1 + self.usual["at_limit"]
        for name, value in {**measures, "at_limit": 1 + measures["at_limit"]}.items():
            ratio = min(value / max(usual[name], LEAST[name]), LARGEST_RATIO[name])
            if name == "residual":
                self.ratios.append(ratio)
            self.excess[name] = max(0.0, self.excess[name] + (ratio - ALLOWED[name]) / self.patience)
        return max(self.excess.values()) > 16

    def _weigh(self) -> None:
        """Add the difference in its standard deviation, if it speaks for the other one."""
        mean = running_mean(self.differences, 100)
        variance = running_mean([value * value for value in self.differences], 100) - mean * mean
        against = self.differences[-1] / max(math.sqrt(max(0.0, variance)), 0.03)
        for_other = against if self.filter_drives else -against
        self.evidence = max(0.0, self.evidence + min(for_other, 5.0) / self.patience)


def running_mean(values: list[float], memory: float) -> float:
    """Return the mean in which each value has a share of 1 / `memory`, the first ones equal shares.

    What is 30 memories old has a share below 1e-13.
    """
    mean = 0.0
    for number, value in list(enumerate(values, start=1))[-int(30 * memory) :]:
        mean += (value - mean) / min(number, memory)
    return mean


@pytest.mark.parametrize(
    ("prefers_plain", "computed", "commands"),
    mostly_slow(2, [(False, math.inf, 36), (True, 0.5, 36), (False, 0.5, 2), (True, math.inf, 2)]),
)
def test_the_rule_equals_its_slow_form(prefers_plain: bool, computed: float, commands: int) -> None:
    """Over frames whose residuals, surprises and limits change at random, with a filter that runs away."""
    rng = np.random.default_rng([prefers_plain, commands])
    guard, patience = new_guard(prefers_plain, computed, 30, commands), max(1.0, 12 / commands)
    evidence = 0.0 if prefers_plain else 16 * (1 - 1 / patience)
    slow = SlowGuard(computed, 30 * patience, patience, filter_drives=False, evidence=evidence)
    chosen, scale = [], np.ones(4)
    frames = 700 if commands == 36 else 1500  # few commands are judged slowly
    for number in range(frames):
        if number % 60 == 0:
            scale = np.exp(rng.normal(0, 0.7, 4))
        learnt, plain, surprise = (scale[:3] * rng.chisquare(5, 3) / 5).tolist()
        learnt = math.inf if number == frames - 100 else learnt
        measures = surprise, float(scale[3] * rng.random()), float(rng.poisson(0.5))
        guard["measures"][[SURPRISE, LEFT_OUT, AT_LIMIT]] = measures
        CHOOSE(guard, learnt, plain)
        slow.frame(learnt, plain, *measures)
        chosen.append(guard["chosen"].item())
        assert chosen[-1] == (not slow.filter_drives)
        assert guard["wait"] == slow.wait
        assert guard["evidence"] == pytest.approx(slow.evidence, rel=1e-9, abs=1e-9, nan_ok=True)
        np.testing.assert_allclose(guard["usual"], list(slow.usual.values()), rtol=1e-12)
    assert np.count_nonzero(np.diff(chosen)) >= 2


def driven(filters: float, integrators: float, frames: int) -> np.ndarray:
    """Return what was chosen; whatever drives, the residual of the integrator is computed as 3."""
    guard, chosen = new_guard(False, math.inf, 60, 36), []
    for _ in range(frames):
        chosen.append(guard["chosen"].item())
        learnt, plain = (filters, 3.0) if guard["chosen"] == 0 else (0.5, integrators)
        CHOOSE(guard, learnt, plain)
    return np.array(chosen)


def test_filter_that_leaves_more_loses_the_mirror_though_its_model_says_less() -> None:
    """Each time for twice as long; one that runs away, for good. The integrator drives first."""
    chosen = driven(1.5, 1.0, 4000)
    changes = np.flatnonzero(np.diff(chosen))
    assert changes[0] == 60
    assert changes[1] < 110
    waits = changes[2::2] - changes[1:-1:2]
    assert waits[0] >= 500
    assert (np.diff(waits) > 0.9 * waits[:-1]).all()
    assert np.count_nonzero(driven(1e6, 1.0, 10_000) == 0) == 1


def test_a_filter_that_becomes_worse_is_replaced_within_30_frames_without_false_alarms() -> None:
    """Both residuals share the turbulence, and each has a scatter that is alike over five frames."""
    rng = np.random.default_rng(3)
    guard, chosen = new_guard(False, math.inf, 60, 36), []
    scatter = [
        np.exp(0.15 * np.convolve(rng.standard_normal(10_004), np.full(5, 5**-0.5), "valid"))
        for _ in range(2)
    ]
    for frame in range(10_000):
        learnt = (0.8 if frame < 9000 else 1.3) * scatter[0][frame]
        CHOOSE(guard, learnt, scatter[1][frame])
        chosen.append(guard["chosen"].item())
    assert np.flatnonzero(np.diff(chosen)).tolist()[0] < 100
    assert not np.any(chosen[100:9000])
    assert chosen[9030] == 1


def test_a_filter_is_replaced_though_it_leaves_little() -> None:
    """By commands at the limit, surprises, or slopes that are not used; not where the integrator has them."""
    for measure, usual, bad, frames in (
        (AT_LIMIT, 0.0, 1.0, 20),
        (AT_LIMIT, 3.0, 3.0, None),
        (SURPRISE, 1.0, 2.5, 20),
        (SURPRISE, 1.3, 1.6, None),
        (LEFT_OUT, 0.0, 2.5, 30),
        (LEFT_OUT, 1.5, 1.8, None),
    ):
        guard, chosen = new_guard(False, math.inf, 60, 36), []
        for number in range(400):
            driving = guard["chosen"] == 0
            guard["measures"][SURPRISE] = 1.0
            guard["measures"][measure] = bad if driving and number > 100 else usual
            CHOOSE(guard, 0.5, 1.0)
            chosen.append(guard["chosen"].item())
        assert not any(chosen[65:101])
        assert any(chosen[101:]) == (frames is not None)
        assert frames is None or chosen[100 + frames] == 1
