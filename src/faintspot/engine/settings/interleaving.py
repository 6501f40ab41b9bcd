"""Interleaved configurations: comparisons on sky, where conditions change quickly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError, errors_within
from faintspot.base.tables import parse_changes
from faintspot.engine.settings.running_settings import check_names
from faintspot.loop.control.base import CONTROLS, split_control
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.pipeline.settings import Settings, without_denoising

_SET, _NONE = "set", "none"
METHODS, FIRST_METHOD, EVERY = "methods", "first_method", "every"
"""Keys of a change of the interleaving in telemetry: names, number of the first, frames per turn."""


@dataclass(frozen=True)
class InterleavedMethod:
    """A configuration that takes turns: its changes of the settings, and its name."""

    label: str
    changes: dict[str, Any]
    denoises: bool = True
    """Whether the estimator's denoising is used."""
    control: str | None = None
    """Controller; None: the configured one."""

    def of(self, settings: Settings) -> Settings:
        """Return the settings with this configuration's changes.

        Raises
        ------
        InputError
            When the changes do not fit, or the estimator has no denoising to leave out.
        """
        if self.changes:
            settings = settings.replace(**self.changes)
        return settings if self.denoises else without_denoising(settings, f"interleave: {self.label!r}")


@dataclass(frozen=True)
class Interleaving:
    """Configurations that take turns.

    Parameters
    ----------
    methods : tuple of InterleavedMethod
    every : int
        Number of frames per turn.
    first : int
        Number of the first configuration in telemetry; those of earlier interleavings keep theirs.
    """

    methods: tuple[InterleavedMethod, ...] = (InterleavedMethod("set", {}),)
    every: int = 1
    first: int = 0

    def __post_init__(self) -> None:
        number_between("every", self.every, 1, integer=True)
        if not self.methods:
            raise InputError("interleave: expected at least one method, got none")

    def method_of(self, count: int) -> int:
        """Return the index of the configuration whose turn it is after `count` frames."""
        return count // self.every % len(self.methods)

    @property
    def labels(self) -> list[str]:
        """Names of the configurations."""
        return [method.label for method in self.methods]

    @property
    def as_change(self) -> dict[str, object]:
        """Change of settings that tells of this interleaving in telemetry."""
        return {METHODS: self.labels, FIRST_METHOD: self.first, EVERY: self.every}

    @classmethod
    def parse(cls, text: str, every: int = 1, first: int = 0) -> Interleaving:
        """Parse a text such as "none,tv:0.6,tv:0.8" or "integrator,map+kalman".

        Each configuration is "set" (the present settings), "none" (the same without denoising), the name of
        an estimator, perhaps with its strength ("tv:0.6"), or new values of settings, NAME=VALUE; more
        values may follow after "+", and a controller. A controller alone has the present settings.

        Raises
        ------
        InputError
            When the text is anything else.
        """
        return cls(tuple(_parsed_method(part.strip()) for part in text.split(",")), every, first)


def methods_after(
    methods: Sequence[str], changes: Iterable[Mapping[str, Any]], first: int = 0
) -> tuple[list[str], int]:
    """Return the names of all configurations by number in telemetry, and the first active number.

    Parameters
    ----------
    methods : sequence of str
        Names at the start.
    changes : iterable of mapping
        Changes from telemetry; those of other settings are ignored.
    first : int
        Number of the first active configuration before the changes.
    """
    names = list(methods)
    for change in changes:
        values = change.get("changes", {})
        number, new = values.get(FIRST_METHOD), values.get(METHODS)
        if isinstance(number, int) and 0 <= number <= len(names) and isinstance(new, list):
            names[number : number + len(new)] = map(str, new)
            first = number
    return names, first


def short_names(methods: Sequence[str]) -> list[str]:
    """Return the methods without the values of their settings, where that leaves them different names."""
    short = []
    for method in methods:
        parts = [part for part in method.split("+") if "=" not in part]
        short.append("+".join(parts) if parts and "=" not in method.split("+")[0] else method)
    texts = dict(zip(methods, short, strict=True))
    names = list(texts.values())
    return [method if names.count(texts[method]) > 1 else texts[method] for method in methods]


def _parsed_method(text: str) -> InterleavedMethod:
    """Return a method: settings, a controller, or both joined with "+"."""
    measured, control = split_control(text)
    measured = measured or _SET if control else text
    with errors_within(f"interleave: {measured!r}"):
        method = _parsed_settings(measured)
    check_names(list(method.changes))
    return replace(method, label=text, control=control or None)


def _parsed_settings(text: str) -> InterleavedMethod:
    first, *others = text.split("+")
    name, colon, strength = first.partition(":")
    changes: dict[str, object] = {}
    if first not in (_SET, _NONE):
        if name in estimators():
            changes["estimator"] = name
        elif colon or "=" not in first:
            names = ", ".join([_SET, _NONE, *estimators()])
            raise InputError(
                f"expected {names}, ESTIMATOR:STRENGTH, NAME=VALUE or one of {', '.join(CONTROLS)}; "
                "several joined with +, the controller last"
            )
        else:
            others = [first, *others]
    if colon:
        others = [f"{_strength_option(name)}={strength}", *others]
    if others:
        changes |= parse_changes(others)
    return InterleavedMethod(text, changes, denoises=first != _NONE)


def _strength_option(name: str) -> str:
    """Return the option of an estimator that ESTIMATOR:STRENGTH sets."""
    option = estimators()[name].strength_option
    if option is None:
        raise InputError(f"expected {name} alone or with +NAME=VALUE; it has no strength")
    return option
