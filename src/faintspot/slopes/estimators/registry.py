"""Registry of estimators by name: built-in, installed and user-defined."""

from __future__ import annotations

import contextlib
import math
import signal
import threading
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from types import FrameType
from typing import Any, TypeVar

from faintspot.base.errors import InputError, import_modules
from faintspot.base.options import Option, Options
from faintspot.slopes.estimators.base import Estimator, Need

_LONGEST = 300


@contextlib.contextmanager
def faults_of(title: str, file: str | None = None) -> Iterator[None]:
    """Convert any exception raised by third-party code to a one-line `InputError`.

    This includes SystemExit, and a KeyboardInterrupt that the code itself raises. Ctrl-C still interrupts.

    Parameters
    ----------
    title : str
        Name of the code; the message begins with it.
    file : str, optional
        Source file of the code; the message states the line in which the error was raised.

    Raises
    ------
    InputError
        For any exception.
    """
    interrupts: list[int] = []
    former: Any = signal.getsignal(signal.SIGINT)
    # Only the main thread receives signals and may change their handlers.
    watched = threading.current_thread() is threading.main_thread() and callable(former)

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        former(number, frame)

    if watched:
        signal.signal(signal.SIGINT, note)
    try:
        yield
    except BaseException as error:
        if interrupts:
            raise KeyboardInterrupt from None
        raise InputError(f"{title}{_line_of(error, file)}: {one_line(error)}") from None
    finally:
        if watched:
            signal.signal(signal.SIGINT, former)


def one_line(error: BaseException) -> str:
    """Return an error's name and text in one line of limited length; of an `InputError` the text alone."""
    text = " ".join(str(error).split())[:_LONGEST]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}".removesuffix(": ")


def _line_of(error: BaseException, file: str | None) -> str:
    """Return the last line of `file` in the error's traceback, as text."""
    line, trace = None, error.__traceback__
    while trace is not None:
        line = trace.tb_lineno if trace.tb_frame.f_code.co_filename == file else line
        trace = trace.tb_next
    return "" if line is None else f" (line {line})"


ENTRY_POINTS = "faintspot.estimators"
_PACKAGE = "faintspot.slopes.estimators.built_in"
_MODULES = {
    "brightest": "gravity",
    "tv": "total_variation",
    "smoothed": "smoothed",
    "centroid": "gravity",
    "thresholded": "gravity",
    "window": "window",
    "weighted": "weighted",
    "ml": "maximum_likelihood",
    "map": "maximum_likelihood",
}
"""Modules of `built_in` by the names of estimators, in the order of lists; one is imported on first use."""

Kind = TypeVar("Kind", bound="type[Estimator]")
_kinds: dict[str, type[Estimator]] = {}


def register(kind: Kind) -> Kind:
    """Register an estimator by its name; use as a class decorator.

    Raises
    ------
    InputError
        If another estimator has that name.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import faintspot as fs
    >>> from faintspot.slopes.estimators import Estimator, register
    >>> @register
    ... @dataclass(frozen=True, eq=False, kw_only=True)
    ... class Middle(Estimator):
    ...     name = "middle"
    ...     label = "the middle of the window"
    ...     def locate(self, images, sensor, prior):
    ...         return sensor.zero
    >>> fs.Settings("middle").estimator.label
    'the middle of the window'
    """
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(f"estimator {kind.__name__}: name = {name!r}: expected a word")
    other, taken = _kinds.get(name), None
    if other is not None and (other.__module__, other.__qualname__) != (kind.__module__, kind.__qualname__):
        taken = other.__module__
    if name in _MODULES and kind.__module__ != f"{_PACKAGE}.{_MODULES[name]}":
        taken = f"{_PACKAGE}.{_MODULES[name]}"
    if taken is not None:
        raise InputError(f"estimator {name!r}: {taken} has one of that name already")
    _kinds[name] = kind
    return kind


def estimators() -> dict[str, type[Estimator]]:
    """Return the classes of all estimators by name, built-in ones first.

    Examples
    --------
    >>> from faintspot.slopes.estimators import estimators
    >>> list(estimators())[:4]
    ['brightest', 'tv', 'smoothed', 'centroid']
    """
    _load()
    return dict(_kinds)


def restore(kinds: Mapping[str, type[Estimator]]) -> None:
    """Restore the registry to a mapping that `estimators` returned before."""
    global _kinds
    _kinds = dict(kinds)


def estimator_named(name: str) -> type[Estimator]:
    """Return the class of the estimator with the given name.

    Raises
    ------
    InputError
        If the name is unknown.

    Examples
    --------
    >>> from faintspot.slopes.estimators import estimator_named
    >>> estimator_named("map").label
    'maximum a posteriori'
    """
    known = isinstance(name, str)
    if known and name not in _kinds:
        if name in _MODULES:
            import_module(f"{_PACKAGE}.{_MODULES[name]}")
        else:
            _load()
    if not known or name not in _kinds:
        raise InputError(
            f"expected one of {', '.join(map(repr, estimators()))}", name="estimator", value=name
        )
    return _kinds[name]


@cache
def _load() -> None:
    """Import the built-in estimators and those of installed packages."""
    import_modules(_PACKAGE)
    # User code that imported one of them directly has changed the order.
    places = {name: place for place, name in enumerate(_MODULES)}
    kinds = sorted(_kinds.values(), key=lambda kind: places.get(kind.name, len(places)))
    _kinds.clear()
    _kinds.update({kind.name: kind for kind in kinds})
    for point in entry_points(group=ENTRY_POINTS):
        package = point.dist.name if point.dist else "?"
        title = f"estimator {point.name!r} of the package {package} (mend or uninstall it)"
        with faults_of(title):
            point.load()


_NEEDS = {Need.READ_NOISE: "read noise", Need.WIDTH: "the spots' width", Need.PSF: "PSF"}


def needs_in_words(kind: type[Estimator]) -> str:
    """Return the prior knowledge that an estimator requires, in a few words."""
    return ", ".join(words for need, words in _NEEDS.items() if need in kind.needs)


def estimator_table() -> str:
    """Return a table of all estimators: name, method, requirements and cost."""
    rows = [
        f"| `{name}` | {kind.method or kind.label} | {needs_in_words(kind)} | {kind.cost:g} |"
        for name, kind in estimators().items()
    ]
    return "\n".join(["| name | method | requires | cost |", "|---|---|---|---|", *rows])


def option_table(kind: type[Options]) -> str:
    """Return a table of the options of one class: name, default, allowed values and meaning."""
    defaults = kind.defaults()
    rows = [
        f"| `{name}` | {_default(defaults[name])} | {allowed_in_words(declared)} | {declared.meaning} |"
        for name, declared in kind.declared().items()
    ]
    return "\n".join(["| key | default | allowed | meaning |", "|---|---|---|---|", *rows])


def all_tables(shared: type[Options]) -> Mapping[str, str]:
    """Return the documentation's tables by name: "estimators", "shared" and one for each estimator."""
    own = {name: option_table(kind) for name, kind in estimators().items()}
    return {"estimators": estimator_table(), "shared": option_table(shared), **own}


def allowed_in_words(declared: Option) -> str:
    """Describe the allowed values of an option, with the unit."""
    if declared.choices:
        parts = [", ".join(f'"{choice}"' for choice in declared.choices)]
    else:
        low, high = declared.low, declared.high
        if math.isinf(high):
            text = f"> {low:g}" if declared.low_open else f">= {low:g}"
        else:
            text = f"{'above ' if declared.low_open else ''}{low:g} to {_plain(high)}"
        parts = [f"{text} {declared.unit}".strip()]
    if declared.automatic:
        parts.append('"auto"')
    if not declared.per_subaperture:
        parts.append("whole sensor")
    return "; ".join(parts)


def _plain(number: float) -> str:
    return f"{int(number)}" if number == int(number) and number < 1e9 else f"{number:g}"


def _default(value: object) -> str:
    if value is None:
        return ""
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
