"""Several states of the settings, in turn: comparisons on sky, where nothing stays the same for long."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.config.written_changes import parse_changes
from faintspot.control.learnt import CONTROLS
from faintspot.estimators.registry import estimators
from faintspot.pipeline.settings import Settings, without_denoising
from faintspot.realtime.live import check_names

_SET, _NONE = "set", "none"
ARMS, FIRST_ARM, EVERY = "arms", "first_arm", "every"
"""What a change of the interleaving is in telemetry: names, number of the first, frames of a turn."""


@dataclass(frozen=True)
class Arm:
    """What differs from the settings that are set, and its name."""

    label: str
    changes: dict[str, Any]
    denoises: bool = True
    """False: the estimator's denoising is left out."""
    control: str | None = None
    """Its controller; None: that which is set."""

    def of(self, settings: Settings) -> Settings:
        """Return what this arm makes of the settings that are set.

        Raises
        ------
        InputError
            For changes that do not fit, and where denoising is to be left out that there is not.
        """
        if self.changes:
            settings = settings.replace(**self.changes)
        return settings if self.denoises else without_denoising(settings, f"interleave: {self.label!r}")


@dataclass(frozen=True)
class Interleaving:
    """Arms that take turns.

    Parameters
    ----------
    arms : tuple of Arm
    every : int
        Frames until the next one's turn.
    first : int
        Number of the first arm in telemetry: those of an engine's earlier interleaving keep theirs.
    """

    arms: tuple[Arm, ...] = (Arm("set", {}),)
    every: int = 1
    first: int = 0

    def __post_init__(self) -> None:
        number_between("every", self.every, 1, integer=True)
        if not self.arms:
            raise InputError("interleave: expected at least one arm, got none")

    def arm_of(self, count: int) -> int:
        """Return whose turn it is, by its place, when so many frames have been measured."""
        return count // self.every % len(self.arms)

    @property
    def labels(self) -> list[str]:
        """The arms' names."""
        return [arm.label for arm in self.arms]

    @classmethod
    def parse(cls, text: str, every: int = 1, first: int = 0) -> Interleaving:
        """Return what a text such as "none,tv" or "noise_std=1,noise_std=2+keep_brightest=20,ml" says.

        Each arm is "set" (the settings as they are set), "none" (the same without denoising), the name of an
        estimator, or new values of settings, NAME=VALUE, with "+" between them; after another "+" its
        controller may follow, as in "map+kalman".

        Raises
        ------
        InputError
            For anything else.
        """
        return cls(tuple(_parsed_arm(part.strip()) for part in text.split(",")), every, first)


def arms_after(
    arms: Sequence[str], changes: Iterable[Mapping[str, Any]], first: int = 0
) -> tuple[list[str], int]:
    """Return the names of all arms by their number in telemetry, and the number of the first that runs.

    Parameters
    ----------
    arms : sequence of str
        At the start.
    changes : iterable of mapping
        Changes as telemetry has them; those of something else count for nothing.
    first : int
        Number of the first that ran before the changes.
    """
    names = list(arms)
    for change in changes:
        values = change.get("changes", {})
        number, new = values.get(FIRST_ARM), values.get(ARMS)
        if isinstance(number, int) and 0 <= number <= len(names) and isinstance(new, list):
            names[number : number + len(new)] = map(str, new)
            first = number
    return names, first


def _parsed_arm(text: str) -> Arm:
    measured, _, control = text.rpartition("+")
    if measured and control in CONTROLS:
        return replace(_parsed_settings(measured), label=text, control=control)
    return _parsed_settings(text)


def _parsed_settings(text: str) -> Arm:
    if text in (_SET, _NONE):
        return Arm(text, {}, denoises=text == _SET)
    if text in estimators():
        return Arm(text, {"estimator": text})
    if "=" in text:
        changes = parse_changes(text.split("+"))
        check_names(list(changes))
        return Arm(text, changes)
    known = ", ".join([_SET, _NONE, *estimators()])
    raise InputError(
        f"interleave: {text!r}: expected {known}, or NAME=VALUE with + between several, then perhaps + and "
        f"one of {', '.join(CONTROLS)}"
    )
