"""Markdown tables of the estimators and their options, generated from the declarations."""

from __future__ import annotations

import math
from collections.abc import Mapping

from faintspot.base.config.options import Option, Options
from faintspot.slopes.estimators.base import Estimator, Need
from faintspot.slopes.estimators.registry import estimators

_NEEDS = {
    Need.READ_NOISE: "read noise",
    Need.WIDTH: "the spots' width",
    Need.PSF: "PSF",
}


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
