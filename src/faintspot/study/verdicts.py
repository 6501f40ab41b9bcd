"""Verdicts on the claims of a paper's text: made from a study's own numbers, by rules that are stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class Outcome(StrEnum):
    """What the numbers say about a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Case:
    """One test of a claim: where, what was found, with errors, and the outcome there."""

    where: str
    finding: str
    outcome: Outcome


@dataclass(frozen=True)
class Finding:
    """All cases of a claim in one mode."""

    mode: str
    cases: Sequence[Case]

    @property
    def outcome(self) -> Outcome:
        """Of all cases together; see `combined`."""
        return combined([case.outcome for case in self.cases])

    def in_words(self) -> str:
        """Return how many cases hold."""
        if not self.cases:
            return "no finished cells for it"
        if len(self.cases) == 1:
            return "one case"
        counts = [sum(case.outcome is outcome for case in self.cases) for outcome in _COUNTED]
        named = [f"{n} {outcome.value}" for n, outcome in zip(counts, _COUNTED, strict=True) if n]
        return f"{len(self.cases)} cases: " + ", ".join(named)


_COUNTED = (Outcome.HOLDS, Outcome.IN_PART, Outcome.FAILS)


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim."""

    number: int
    claim: str
    rule: str
    best: Finding
    fixed: Finding

    @property
    def outcome(self) -> Outcome:
        """Of both modes together."""
        measured = [item.outcome for item in (self.best, self.fixed) if item.cases]
        return combined(measured)


def combined(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the outcome of several: all hold, none does, or anything between."""
    measured = [outcome for outcome in outcomes if outcome is not Outcome.NOT_MEASURED]
    if not measured:
        return Outcome.NOT_MEASURED
    if all(outcome is Outcome.HOLDS for outcome in measured):
        return Outcome.HOLDS
    return Outcome.FAILS if all(outcome is Outcome.FAILS for outcome in measured) else Outcome.IN_PART


def judged(holds: bool, in_part: bool) -> Outcome:
    """Return the outcome of one case."""
    if holds:
        return Outcome.HOLDS
    return Outcome.IN_PART if in_part else Outcome.FAILS


def with_error(value: float, error: float) -> str:
    """Return "0.1327 ± 0.0012"."""
    return f"{value:.4f} ± {error:.4f}"
