"""The texts of pages: each is asked for by a module that reads its file, with the values that it names."""

from __future__ import annotations

import ast
import re
import string
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

PACKAGES = ("faintspot.experiments", "faintspot.slopes.recorded")
PARTS = r"(\.(title|caption|columns))?"  # `Texts.figure` and `Texts.table` take these of a table


def leaves(content: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def texts_of(package: str) -> dict[str, Any]:
    text = files(package).joinpath("texts.toml").read_text(encoding="utf-8")
    return dict(leaves(tomllib.loads(text)))


def placeholders(text: object) -> set[str]:
    """Return the names in braces; none of a list."""
    parsed = string.Formatter().parse(text) if isinstance(text, str) else ()
    return {re.split(r"[.\[]", name)[0] for _, name, _, _ in parsed if name}


@cache
def asked_for(package: str) -> tuple[tuple[str, frozenset[str] | None], ...]:
    """Return the patterns of names that modules ask for, and the values given with each; None: not known."""
    found: list[tuple[str, frozenset[str] | None]] = []
    for path in Path(str(files("faintspot"))).rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        if f'Texts("{package}")' not in code:
            continue
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Subscript) and re.match(r"_TEXT$|Texts\(", ast.unparse(node.value)):
                found += [(name, None) for name in names(node.slice)]
            elif isinstance(node, ast.Call) and re.match(r"_TEXT(\.\w+)?$", ast.unparse(node.func)):
                given = frozenset(each.arg for each in node.keywords if each.arg is not None)
                known = len(given) == len(node.keywords)
                found += [(name, given if known else None) for name in names(node.args[0])]
    return tuple(found)


def names(node: ast.expr) -> list[str]:
    """Return patterns of the names that an expression may be."""
    if isinstance(node, ast.JoinedStr):
        parts = (
            re.escape(str(each.value)) if isinstance(each, ast.Constant) else "[^.]+" for each in node.values
        )
        return ["".join(parts)]
    if isinstance(node, ast.IfExp):
        return names(node.body) + names(node.orelse)
    return [re.escape(node.value)] if isinstance(node, ast.Constant) and isinstance(node.value, str) else []


@pytest.mark.parametrize(("package", "name"), [(each, name) for each in PACKAGES for name in texts_of(each)])
def test_every_text_is_used_and_filled_in(package: str, name: str) -> None:
    needed = placeholders(texts_of(package)[name])
    users = [given for pattern, given in asked_for(package) if re.fullmatch(pattern + PARTS, name)]
    whole_tables = [pattern for pattern, _ in asked_for(package) if re.match(rf"{pattern}\.", name)]
    assert users or whole_tables
    assert all(given is None or needed <= given for given in users)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_that_modules_ask_for_is_there(package: str) -> None:
    every = texts_of(package)
    asked = {pattern for pattern, _ in asked_for(package)}
    assert len(asked) > 20
    assert not [
        pattern for pattern in asked if not any(re.match(rf"{pattern}(\.|$)", name) for name in every)
    ]
